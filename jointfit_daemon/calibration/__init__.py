"""Calibration of a limb: trials, settings, and fits of alignments, joints and models."""

from jointfit_daemon.calibration._errors import CalibrationError
from jointfit_daemon.calibration._trial import (
    PLATE,
    CalibrationSettings,
    CalibrationTrial,
    OnlineFrames,
    OpticalTrack,
    SensorTrack,
)

__all__ = [
    "PLATE",
    "CalibrationError",
    "CalibrationSettings",
    "CalibrationTrial",
    "OnlineFrames",
    "OpticalTrack",
    "SensorTrack",
]
