"""Orientation trials (NPZ) and tables over time (STO, MOT)."""

from jointfit_daemon.files.orientations._npz import (
    OrientationTrial,
    read_arrays,
    read_orientations_npz,
    write_orientations_npz,
)
from jointfit_daemon.files.orientations._sto import (
    OrientationTable,
    TimeTable,
    read_orientations_sto,
    read_sto,
    write_orientations_sto,
    write_sto,
)

__all__ = [
    "OrientationTable",
    "OrientationTrial",
    "TimeTable",
    "read_arrays",
    "read_orientations_npz",
    "read_orientations_sto",
    "read_sto",
    "write_orientations_npz",
    "write_orientations_sto",
    "write_sto",
]
