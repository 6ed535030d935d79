"""Correlation of the errors of two segments, and the standard deviation of their joint angle."""

from __future__ import annotations

from math import hypot, sqrt

import numpy as np
import pytest

from jointfit_daemon.calibration.soft_tissue import (
    LimbTraining,
    SegmentTraining,
    error_correlation,
    fit_all_sensors,
    joint_error_correlations,
    predict_all_sensors,
)
from jointfit_daemon.fusion._forward_kinematics import joint_angle_estimate
from jointfit_daemon.fusion._segment_fuser import FusedSegment
from jointfit_daemon.kinematics import rotation as rot
from jointfit_daemon.limb_model import Calibration, CalibrationSchemaError
from jointfit_daemon.model import Chain
from tests.calibration.calibrated_subject import calibration

N = 600
CHAIN = Chain(("hip", "knee", "ankle"), ("thigh", "shank"), (("S1", "S2"), ("S3", "S4")))


def limb(alike: float, seed: int = 1) -> LimbTraining:
    """Return squats in which all sensors of a segment have the same random error about x.

    The error does not depend on posture. `alike` is the correlation of the errors of thigh and
    shank.
    """
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 60.0, N)
    bend = np.column_stack([0.6 - 0.6 * np.cos(t), 0.05 * np.sin(0.7 * t), 0.05 * np.sin(t)])
    thigh, shank = rot.exp(0.5 * bend), rot.exp(-0.5 * bend)
    one, other = np.repeat(rng.normal(0.0, 0.03, (2, N // 3)), 3, axis=1)
    errors = {"thigh": one, "shank": alike * one + sqrt(1.0 - alike**2) * other}
    said = {}
    for names, segment, bone in zip(CHAIN.sensors, CHAIN.segments, (thigh, shank), strict=True):
        off = np.zeros((N, 3))
        off[:, 0] = errors[segment]
        for name in names:
            noise = rng.normal(0.0, 0.002, (N, 3))
            said[name] = rot.multiply(bone, rot.exp(off + noise))
    return LimbTraining(said, {"thigh": thigh, "shank": shank})


@pytest.mark.parametrize("alike", [-0.8, 0.0, 0.8])
def test_error_correlation_of_held_out_frames_applies_to_later_frames(alike: float) -> None:
    training, later = limb(alike), limb(alike, seed=2)
    found = joint_error_correlations(CHAIN, training, "anchored")
    assert found.keys() == {"knee"}
    left = []
    for i, segment in enumerate(CHAIN.segments):
        model = fit_all_sensors(CHAIN, i, "anchored", training)
        said = predict_all_sensors(CHAIN, i, model, later)
        left.append(rot.log(rot.multiply(rot.conjugate(said), later.reference[segment]))[:, 0])
    actual = np.corrcoef(np.stack(left))
    assert abs(found["knee"] - float(np.asarray(actual)[0, 1])) < 0.15


def test_correlation_of_identical_errors_is_limited() -> None:
    training = limb(0.0)
    a, b = training.sensors["S1"], training.sensors["S2"]
    same = SegmentTraining.of([a, b], training.sensors["S3"], training.reference["thigh"])
    assert error_correlation(same, same) == 0.9


def test_joint_with_few_complete_frames_has_no_error_correlation() -> None:
    training = limb(0.5)
    hidden = training.reference["shank"].copy()
    hidden[29:] = np.nan
    partly = LimbTraining(training.sensors, {**training.reference, "shank": hidden})
    assert joint_error_correlations(CHAIN, partly, "anchored") == {}
    assert joint_error_correlations(CHAIN, training, "mean") == {}


def test_opposite_errors_make_a_joint_less_sure_and_like_ones_surer() -> None:
    """A joint angle is a difference of two segments, so equal errors of both segments cancel."""
    above = FusedSegment((1.0, 0.0, 0.0, 0.0), 0.05, ("S1",), (), 0.03)
    below = FusedSegment((1.0, 0.0, 0.0, 0.0), 0.05, ("S3",), (), 0.04)

    def sd(alike: float) -> float:
        state = joint_angle_estimate(above, below, sign=-1.0, left=False, correlation=alike)
        assert state is not None
        assert state.main_sd is not None
        return state.main_sd

    assert sd(0.0) == pytest.approx(hypot(0.03, 0.04))
    assert sd(-0.5) == pytest.approx(sqrt(0.0025 + 0.0012))
    assert sd(0.5) == pytest.approx(sqrt(0.0025 - 0.0012))


def test_errors_of_held_or_inconsistent_segments_are_independent() -> None:
    """The correlation applies to model errors only, not to held orientations or sensor faults."""
    above = FusedSegment((1.0, 0.0, 0.0, 0.0), 0.05, ("S1",), (), 0.03)
    below = FusedSegment((1.0, 0.0, 0.0, 0.0), 0.4, (), ("held:shank",))

    def sd(one: FusedSegment, other: FusedSegment) -> float:
        state = joint_angle_estimate(one, other, sign=-1.0, left=False, correlation=0.9)
        assert state is not None
        assert state.main_sd is not None
        return state.main_sd

    assert sd(above, below) == pytest.approx(hypot(0.03, 0.4))
    assert sd(below, below) == pytest.approx(hypot(0.4, 0.4))
    doubted = above._replace(fault_sd=0.2)
    models = 2.0 * 0.03**2 * (1.0 - 0.9)
    assert sd(doubted, doubted) == pytest.approx(sqrt(models + 2.0 * 0.2**2))


@pytest.mark.parametrize("rho", [1.0, -1.5, float("nan")])
def test_a_stored_correlation_that_cannot_be_is_no_calibration(rho: float) -> None:
    """A correlation between -1 and 1 gives a positive variance of the joint angle."""
    data = calibration().to_dict()
    assert Calibration.from_dict({**data, "correlations": {"knee": -0.3}}).correlations == {
        "knee": -0.3
    }
    with pytest.raises(CalibrationSchemaError, match="correlation"):
        Calibration.from_dict({**data, "correlations": {"knee": rho}})
