"""`jointfit calibrate`: guides a functional calibration of a running daemon over MQTT."""

from jointfit_daemon.tools.calibrate._command import calibrate
from jointfit_daemon.tools.calibrate._offline import store_offline_calibration
from jointfit_daemon.tools.calibrate._phase_tracker import (
    PhaseAbortedError,
    PhaseTracker,
    RequestRefusedError,
)
from jointfit_daemon.tools.calibrate._report import movement_lines, report

__all__ = [
    "PhaseAbortedError",
    "PhaseTracker",
    "RequestRefusedError",
    "calibrate",
    "movement_lines",
    "report",
    "store_offline_calibration",
]
