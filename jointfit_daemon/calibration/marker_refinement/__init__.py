"""Refinement of marker positions on their segments from movements."""

from jointfit_daemon.calibration.marker_refinement._block_descent import Carriers
from jointfit_daemon.calibration.marker_refinement._coordinate_search import SearchSettings, search
from jointfit_daemon.calibration.marker_refinement._evaluation import evaluate_trial
from jointfit_daemon.calibration.marker_refinement._input_checks import (
    MOST_RMS_M,
    exchange_text,
    exchanged_markers,
    find_trial_faults,
)
from jointfit_daemon.calibration.marker_refinement._marker_options import (
    require_marker,
    with_locks,
    with_weights,
)
from jointfit_daemon.calibration.marker_refinement._motion_trial import (
    MotionTrial,
    RefinementError,
    RefinementSettings,
)
from jointfit_daemon.calibration.marker_refinement._refine import STOPPED, refine_markers
from jointfit_daemon.calibration.marker_refinement._refinement_result import (
    MarkerOutcome,
    Refinement,
    TrackingStatistics,
    TrialOutcome,
)

__all__ = [
    "MOST_RMS_M",
    "STOPPED",
    "Carriers",
    "MarkerOutcome",
    "MotionTrial",
    "Refinement",
    "RefinementError",
    "RefinementSettings",
    "SearchSettings",
    "TrackingStatistics",
    "TrialOutcome",
    "evaluate_trial",
    "exchange_text",
    "exchanged_markers",
    "find_trial_faults",
    "refine_markers",
    "require_marker",
    "search",
    "with_locks",
    "with_weights",
]
