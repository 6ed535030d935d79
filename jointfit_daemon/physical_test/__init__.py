"""Physical test of a sensor: three rotations by hand show whether its frames are as configured.

Invariant: the result of a test depends only on the received chunks. A live test and a recorded test
with the same chunks have the same result.
"""

from jointfit_daemon.physical_test._frame_evaluation import explain_frames, fit_frames
from jointfit_daemon.physical_test._outcome_lines import ROTATIONS, correction_lines
from jointfit_daemon.physical_test._physical_test import (
    STEPS,
    PhysicalTest,
    PhysicalTestResult,
    evaluate_recording,
)
from jointfit_daemon.physical_test._rest_finder import RestFinder

__all__ = [
    "ROTATIONS",
    "STEPS",
    "PhysicalTest",
    "PhysicalTestResult",
    "RestFinder",
    "correction_lines",
    "evaluate_recording",
    "explain_frames",
    "fit_frames",
]
