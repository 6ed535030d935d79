"""The text on a missing movement contains the random error of the joint center and the target."""

from __future__ import annotations

import re

import numpy as np
import pytest

from jointfit_daemon.calibration.guidance._live_joint_centers import LiveJointCenter
from jointfit_daemon.calibration.guidance._movement_guide import _missing_movement
from jointfit_daemon.calibration.guidance._movement_instructions import JointInstructions

ORIGIN = np.zeros(3)
TARGET_M = 0.003


@pytest.mark.parametrize("noise_m", [0.003001, 0.00304, 0.0031, 0.0105])
def test_an_unmet_target_is_never_displayed_as_met(noise_m: float) -> None:
    hip = LiveJointCenter("hip", ORIGIN, noise_m, noise_m, 0.02, 1.0, 9.0, 500, 0, None)
    text = _missing_movement(hip, JointInstructions("squat", "swing the leg"), TARGET_M)
    assert text is not None
    shown = re.search(r"error (?:of )?([\d.]+) mm, target 3 mm: squat", text)
    assert shown is not None, text
    assert float(shown[1]) > 3.0


def test_a_met_target_needs_no_movement() -> None:
    hip = LiveJointCenter("hip", ORIGIN, TARGET_M, TARGET_M, 0.02, 1.0, 9.0, 500, 0, None)
    assert _missing_movement(hip, JointInstructions("squat", "swing the leg"), TARGET_M) is None
