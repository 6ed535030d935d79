"""Quantities of a whole session: gait cycles, ranges of motion, camera differences and gaps."""

from jointfit_daemon.session_analysis._gait import (
    LEAST_CYCLES,
    CycleCurves,
    GaitCycles,
    find_gait_cycles,
    normalize_cycles,
)
from jointfit_daemon.session_analysis._statistics import (
    QUANTILE_95,
    AngleDifference,
    MotionRange,
    SeriesQuality,
    angle_difference,
    motion_range,
    series_quality,
)

__all__ = [
    "LEAST_CYCLES",
    "QUANTILE_95",
    "AngleDifference",
    "CycleCurves",
    "GaitCycles",
    "MotionRange",
    "SeriesQuality",
    "angle_difference",
    "find_gait_cycles",
    "motion_range",
    "normalize_cycles",
    "series_quality",
]
