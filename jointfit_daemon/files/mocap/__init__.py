"""Marker trials of motion-capture systems: TRC and C3D."""

from jointfit_daemon.files.mocap._c3d import C3dTrial, MissingPackageError, read_c3d
from jointfit_daemon.files.mocap._c3d_writer import MOST_ITEMS, C3dEvent, c3d_bytes
from jointfit_daemon.files.mocap._marker_trial import (
    MarkerTrial,
    UnknownMarkerError,
    read_marker_trial,
)
from jointfit_daemon.files.mocap._trc import MarkerTrajectories, read_trc, write_trc

__all__ = [
    "MOST_ITEMS",
    "C3dEvent",
    "C3dTrial",
    "MarkerTrajectories",
    "MarkerTrial",
    "MissingPackageError",
    "UnknownMarkerError",
    "c3d_bytes",
    "read_c3d",
    "read_marker_trial",
    "read_trc",
    "write_trc",
]
