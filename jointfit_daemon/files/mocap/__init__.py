"""Marker trials of motion-capture systems: TRC and C3D."""

from jointfit_daemon.files.mocap._marker_trial import (
    MarkerTrial,
    UnknownMarkerError,
    read_marker_trial,
)
from jointfit_daemon.files.mocap._trc import MarkerTrajectories, read_trc, write_trc

__all__ = [
    "MarkerTrajectories",
    "MarkerTrial",
    "UnknownMarkerError",
    "read_marker_trial",
    "read_trc",
    "write_trc",
]
