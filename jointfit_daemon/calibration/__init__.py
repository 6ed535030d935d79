"""Calibration of a limb: trials, settings, and fits of alignments, joints and models."""

from jointfit_daemon.calibration._errors import CalibrationError
from jointfit_daemon.calibration._jobs import (
    AlignJob,
    CalibrationJob,
    FitResult,
    FunctionalJob,
    JobControl,
    RefitJob,
    StaticJob,
)
from jointfit_daemon.calibration._refinement_choices import (
    METHODS_OF_OPTION,
    RefinementCost,
    RefinementMethod,
)
from jointfit_daemon.calibration._trial import (
    PLATE,
    CalibrationSettings,
    CalibrationTrial,
    CenterMethod,
    ChainRefinement,
    OnlineFrames,
    OpticalTrack,
    SensorTrack,
)

__all__ = [
    "METHODS_OF_OPTION",
    "PLATE",
    "AlignJob",
    "CalibrationError",
    "CalibrationJob",
    "CalibrationSettings",
    "CalibrationTrial",
    "CenterMethod",
    "ChainRefinement",
    "FitResult",
    "FunctionalJob",
    "JobControl",
    "OnlineFrames",
    "OpticalTrack",
    "RefinementCost",
    "RefinementMethod",
    "RefitJob",
    "SensorTrack",
    "StaticJob",
]
