"""Learning how sensors sit, where joints turn, and how redundant sensors combine. Pure."""

from jointfit_daemon.calibration._errors import CalibrationRefused
from jointfit_daemon.calibration._trial import (
    PLATE,
    CalibrationSettings,
    CalibrationTrial,
    Fresh,
    OpticalTrack,
    SensorTrack,
)

__all__ = [
    "PLATE",
    "CalibrationRefused",
    "CalibrationSettings",
    "CalibrationTrial",
    "Fresh",
    "OpticalTrack",
    "SensorTrack",
]
