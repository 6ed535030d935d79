"""Command `jointfit calibrate`: guides the calibration of a running daemon over MQTT."""

from jointfit_daemon.tools.calibrate._command import calibrate
from jointfit_daemon.tools.calibrate._offline import store_offline_calibration
from jointfit_daemon.tools.calibrate._phase_tracker import (
    PhaseAbortedError,
    PhaseTracker,
    RequestRefusedError,
    raise_if_refused,
)
from jointfit_daemon.tools.calibrate._report import movement_lines, report

__all__ = [
    "PhaseAbortedError",
    "PhaseTracker",
    "RequestRefusedError",
    "calibrate",
    "movement_lines",
    "raise_if_refused",
    "report",
    "store_offline_calibration",
]
