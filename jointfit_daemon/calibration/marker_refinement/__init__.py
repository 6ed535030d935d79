"""Where markers are on their segments, learned from movements, and what that is worth."""

from jointfit_daemon.calibration.marker_refinement._block_descent import Carriers
from jointfit_daemon.calibration.marker_refinement._coordinate_search import search
from jointfit_daemon.calibration.marker_refinement._motion_trial import (
    MotionTrial,
    RefinementMethod,
    RefinementSettings,
    Unrefinable,
)
from jointfit_daemon.calibration.marker_refinement._refine import refine_markers
from jointfit_daemon.calibration.marker_refinement._refinement_result import (
    Fit,
    MarkerOutcome,
    Refinement,
    TrialOutcome,
)

__all__ = [
    "Carriers",
    "Fit",
    "MarkerOutcome",
    "MotionTrial",
    "Refinement",
    "RefinementMethod",
    "RefinementSettings",
    "TrialOutcome",
    "Unrefinable",
    "refine_markers",
    "search",
]
