"""The physical test: three rotations by hand show whether a sensor's frames are as configured.

Invariant: pure. A test depends on its chunks only, live and recorded.
"""

from jointfit_daemon.physical_test._frame_judgement import explain_frames, fit_frames
from jointfit_daemon.physical_test._outcome_lines import ROTATIONS, correction_lines
from jointfit_daemon.physical_test._physical_test import (
    STEPS,
    PhysicalTest,
    PhysicalTestResult,
    judge_recording,
)
from jointfit_daemon.physical_test._rest_finder import RestFinder

__all__ = [
    "ROTATIONS",
    "STEPS",
    "PhysicalTest",
    "PhysicalTestResult",
    "RestFinder",
    "correction_lines",
    "explain_frames",
    "fit_frames",
    "judge_recording",
]
