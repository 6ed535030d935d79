"""`jointfit calibrate`: guides a functional calibration of a running daemon over MQTT."""

from jointfit_daemon.tools.calibrate._command import calibrate
from jointfit_daemon.tools.calibrate._phase_tracker import (
    CalibrationWatch,
    PhaseAborted,
    RequestRefused,
)
from jointfit_daemon.tools.calibrate._report import movement_lines, report

__all__ = [
    "CalibrationWatch",
    "PhaseAborted",
    "RequestRefused",
    "calibrate",
    "movement_lines",
    "report",
]
