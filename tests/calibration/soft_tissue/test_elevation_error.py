"""The error of a shoulder is its elevation error, as flexion is undefined at 90° abduction."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.calibration.guidance._movement_instructions import instructions_for
from jointfit_daemon.calibration.phases._online import _figures
from jointfit_daemon.calibration.soft_tissue import LimbTraining, evaluate_methods, flexion_error
from jointfit_daemon.limb_model import MeanModel
from jointfit_daemon.model import AngleConvention, Chain

N = 200
REST = np.tile([1.0, 0.0, 0.0, 0.0], (N, 1))


def quaternions(turns: Rotation) -> np.ndarray:
    return np.asarray(turns.as_quat(scalar_first=True))


@given(
    plane=st.floats(-3.0, 3.0),
    elevation=st.floats(0.1, 3.0),
    error=st.tuples(*[st.floats(-0.05, 0.05)] * 3),
)
def test_an_elevation_error_is_at_most_the_rotation_error(
    plane: float, elevation: float, error: tuple[float, float, float]
) -> None:
    turn = Rotation.from_euler("ZYZ", [[plane, -elevation, 0.4]])
    wrong = turn * Rotation.from_rotvec(error)
    found = flexion_error(
        (REST[:1], quaternions(wrong)), (REST[:1], quaternions(turn)), AngleConvention.ELEVATION
    )
    assert found <= math.hypot(*error) + 1e-9


def test_an_error_along_the_elevation_is_found_exactly() -> None:
    turn, wrong = (Rotation.from_euler("ZYZ", [[0.3, -e, 0.4]]) for e in (1.5, 1.6))
    truth, estimate = (REST[:1], quaternions(turn)), (REST[:1], quaternions(wrong))
    for convention in (AngleConvention.ELEVATION, AngleConvention.TILT_TORSION):
        assert flexion_error(estimate, truth, convention) == pytest.approx(0.1)


@pytest.mark.parametrize(("joint", "most_deg"), [("shoulder", 3.5), ("elbow", math.inf)])
def test_holdout_and_online_errors_of_an_abducted_shoulder_are_not_magnified(
    joint: str, most_deg: float
) -> None:
    """Near 90° of abduction, errors of 1° cause large errors of flexion, but not of elevation."""
    rng = np.random.default_rng(2)
    raised = Rotation.from_rotvec(np.outer(np.radians(rng.uniform(85.0, 95.0, N)), [0, -1, 0]))
    noisy = raised * Rotation.from_rotvec(rng.normal(0.0, math.radians(1.0), (N, 3)))
    chain = Chain(("acromion", joint, "wrist"), ("thorax", "arm"), (("A",), ("B",)))
    training = LimbTraining(
        {"A": REST, "B": quaternions(noisy)}, {"thorax": REST, "arm": quaternions(raised)}
    )
    mean = MeanModel((1.0,), 0.02)
    held_out = evaluate_methods(chain, training, "mean", 0.4).flexion[joint].mean
    online = _figures(chain, {"thorax": mean, "arm": mean}, training)[joint]
    assert held_out is not None
    for error in (held_out, online):
        assert math.degrees(error) < most_deg
        assert (math.degrees(error) > 10.0) is (joint == "elbow")


@pytest.mark.parametrize(
    ("joint", "word"), [("lumbar", "forward"), ("neck", "head"), ("Trunk", "straighten")]
)
def test_instructions_for_joints_of_the_trunk_name_their_movement(joint: str, word: str) -> None:
    assert word in instructions_for(joint).bend
