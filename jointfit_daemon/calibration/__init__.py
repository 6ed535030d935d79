"""Calibration of a limb: trials, settings, and fits of alignments, joints and models."""

from jointfit_daemon.calibration._errors import CalibrationError
from jointfit_daemon.calibration._jobs import (
    AlignJob,
    CalibrationJob,
    FitResult,
    FunctionalJob,
    RefitJob,
    StaticJob,
)
from jointfit_daemon.calibration._trial import (
    PLATE,
    CalibrationSettings,
    CalibrationTrial,
    CenterMethod,
    OnlineFrames,
    OpticalTrack,
    SensorTrack,
)

__all__ = [
    "PLATE",
    "AlignJob",
    "CalibrationError",
    "CalibrationJob",
    "CalibrationSettings",
    "CalibrationTrial",
    "CenterMethod",
    "FitResult",
    "FunctionalJob",
    "OnlineFrames",
    "OpticalTrack",
    "RefitJob",
    "SensorTrack",
    "StaticJob",
]
