"""Marker positions on their segments, refined on movements."""

from jointfit_daemon.calibration.marker_refinement._block_descent import Carriers
from jointfit_daemon.calibration.marker_refinement._coordinate_search import SearchSettings, search
from jointfit_daemon.calibration.marker_refinement._input_checks import (
    MOST_RMS_M,
    exchanged_markers,
    find_trial_faults,
)
from jointfit_daemon.calibration.marker_refinement._motion_trial import (
    MotionTrial,
    RefinementCost,
    RefinementError,
    RefinementMethod,
    RefinementSettings,
)
from jointfit_daemon.calibration.marker_refinement._refine import refine_markers
from jointfit_daemon.calibration.marker_refinement._refinement_result import (
    MarkerOutcome,
    Refinement,
    TrackingStatistics,
    TrialOutcome,
)

__all__ = [
    "MOST_RMS_M",
    "Carriers",
    "MarkerOutcome",
    "MotionTrial",
    "Refinement",
    "RefinementCost",
    "RefinementError",
    "RefinementMethod",
    "RefinementSettings",
    "SearchSettings",
    "TrackingStatistics",
    "TrialOutcome",
    "exchanged_markers",
    "find_trial_faults",
    "refine_markers",
    "search",
]
