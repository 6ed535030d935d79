"""Orientation trials (NPZ) and tables over time (STO, MOT)."""

from jointfit_daemon.files.orientations._known_part import (
    WrittenTable,
    complete_part,
    write_known_orientations,
    write_known_values,
)
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
    "WrittenTable",
    "complete_part",
    "read_arrays",
    "read_orientations_npz",
    "read_orientations_sto",
    "read_sto",
    "write_known_orientations",
    "write_known_values",
    "write_orientations_npz",
    "write_orientations_sto",
    "write_sto",
]
