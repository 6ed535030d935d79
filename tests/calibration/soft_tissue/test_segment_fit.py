"""Segment models on a simulated limb with soft-tissue artefact, for arrays and single frames."""

from __future__ import annotations

import json
from typing import get_args

import numpy as np
import pytest

from jointfit_daemon.calibration.soft_tissue import SegmentTraining, fit_segment
from jointfit_daemon.kinematics import rotation as rot
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import (
    AlignedModel,
    KernelModel,
    MeanModel,
    Method,
    PatentModel,
    SegmentModel,
)

METHODS: tuple[Method, ...] = get_args(Method)
DEG = np.deg2rad(1.0)
N = 600


class Limb:
    """Knee with flexion and rotation; the soft-tissue artefact of each sensor follows flexion."""

    def __init__(self, seed: int = 0, sensors: int = 2, range_rad: float = 1.2) -> None:
        rng = np.random.default_rng(seed)
        t = np.linspace(0, 20, N)
        bend = range_rad * (0.5 - 0.5 * np.cos(1.3 * t + seed))
        twist = 0.15 * np.sin(0.7 * t)
        joint = np.column_stack([-bend, 0.1 * np.sin(t), twist])
        lean = np.column_stack([0.4 * np.sin(0.9 * t), 0.1 * np.cos(t), 0.2 * np.sin(0.4 * t)])
        self.segment = rot.exp(lean)
        shank = rot.multiply(self.segment, rot.exp(joint))
        self.other = rot.multiply(shank, rot.exp(0.05 * joint))
        self.sensors = [
            rot.multiply(self.segment, rot.exp(joint @ skin + rng.normal(0, 0.3 * DEG, (N, 3))))
            for skin in rng.normal(0, 0.06, (sensors, 3, 3)) + 0.05 * np.eye(3)
        ]

    def fit(self, method: Method, frames: slice = slice(0, 360)) -> SegmentModel:
        sensors = [q[frames] for q in self.sensors]
        return fit_segment(method, sensors, self.other[frames], self.segment[frames])

    def error(self, model: SegmentModel, frames: slice = slice(360, N)) -> float:
        said = model.predict([q[frames] for q in self.sensors], self.other[frames])
        return float(np.sqrt(np.mean(rot.angle_between(said, self.segment[frames]) ** 2)))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("sensors", [1, 2, 3])
def test_single_frame_result_equals_the_array_result(method: Method, sensors: int) -> None:
    limb = Limb(sensors=sensors)
    model = limb.fit(method)
    array = model.predict(limb.sensors, limb.other)
    for i in range(0, N, 20):
        said = model.predict_one(
            [as_quaternion(q[i]) for q in limb.sensors], as_quaternion(limb.other[i])
        )
        assert rot.angle_between(said.q, array[i]) < 1e-9
        assert said.sd > 0


@pytest.mark.parametrize("method", METHODS)
def test_a_model_survives_text_to_the_last_bit(method: Method) -> None:
    limb = Limb()
    model = limb.fit(method)
    again = SegmentModel.from_dict(json.loads(json.dumps(model.to_dict())))
    assert again == model
    assert type(again) is type(model)
    assert hash(again) == hash(model)
    assert np.array_equal(
        again.predict(limb.sensors, limb.other), model.predict(limb.sensors, limb.other)
    )
    assert limb.fit(method, slice(0, 300)) != model


def test_an_unknown_kind_of_model_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="'oracle'; known"):
        SegmentModel.from_dict({"kind": "oracle"})


def test_mean_weights_all_sensors_equally() -> None:
    limb = Limb()
    limb.sensors[1] = rot.multiply(limb.sensors[1], rot.exp(np.array([0.3, 0.0, 0.0])))
    said = limb.fit("mean").predict(limb.sensors)
    first, second = (rot.angle_between(said, q) for q in limb.sensors)
    assert np.allclose(first, second, atol=1e-9)
    learned = limb.error(limb.fit("mean"), slice(0, 360))
    assert limb.fit("mean").residual_sd * np.sqrt(3) == pytest.approx(learned)


def test_the_single_is_the_sensor_that_was_nearest_in_training_bit_for_bit() -> None:
    """The method `single` returns the orientations of the best sensor of the training."""
    limb = Limb(sensors=3)
    limb.sensors[0] = rot.multiply(limb.sensors[0], rot.exp(np.array([0.3, 0.0, 0.0])))
    errors = [float(np.mean(rot.angle_between(q, limb.segment)[:360] ** 2)) for q in limb.sensors]
    best = int(np.argmin(errors))
    assert best != 0
    said = limb.fit("single").predict(limb.sensors)
    assert np.max(rot.angle_between(said, limb.sensors[best])) < 1e-12


def test_markley_removes_constant_rotations_and_weights_the_residuals() -> None:
    """The expected values follow from the construction: constant rotations with any signs."""
    rng = np.random.default_rng(3)
    limb = Limb()
    free = [rot.multiply(limb.segment, rot.exp(s * rng.normal(size=(N, 3)))) for s in (0.01, 0.03)]
    for k, q in enumerate(free):
        world = rot.heading(np.array(0.4 - k))
        mount = rot.exp(np.array([0.2, -0.3 * k, 0.1]))
        limb.sensors[k] = rot.multiply(rot.multiply(world, q), mount) * rng.choice([-1, 1], (N, 1))
    model = limb.fit("markley")
    assert isinstance(model, AlignedModel)
    assert model.weights[0] == pytest.approx(0.9, abs=0.02)
    expected = rot.average(np.stack(free, axis=1), np.broadcast_to([0.9, 0.1], (N, 2)))
    assert np.max(rot.angle_between(model.predict(limb.sensors), expected)) < 0.3 * DEG
    assert limb.error(limb.fit("mean")) > 10 * limb.error(model)


def test_corrections_beat_the_mean_on_movement_they_did_not_see() -> None:
    limb = Limb()
    mean = limb.error(limb.fit("mean"))
    assert limb.error(limb.fit("anchored")) < 0.35 * mean  # sensor noise remains
    assert limb.error(limb.fit("patent12")) < 0.8 * mean


@pytest.mark.parametrize("method", ["anchored", "mean", "single"])
@pytest.mark.parametrize("turn", [0.2, 1.5, 3.1])
def test_rotated_world_only_rotates_the_result(method: Method, turn: float) -> None:
    limb = Limb()
    model = limb.fit(method)
    world = rot.exp([0.0, 0.0, turn] if method == "anchored" else [0.3, -0.2, turn])
    straight = model.predict(limb.sensors, limb.other)
    turned = model.predict(
        [rot.multiply(world, q) for q in limb.sensors], rot.multiply(world, limb.other)
    )
    assert np.max(rot.angle_between(turned, rot.multiply(world, straight))) < 1e-11


def test_anchored_correction_is_zero_in_the_static_pose() -> None:
    model = Limb().fit("anchored")
    pose = (0.6, 0.0, 0.0, 0.8)  # upright with any heading
    assert rot.angle_between(model.predict_one([pose, pose], pose).q, pose) < 1e-12


def test_correction_fades_outside_the_training_range_with_a_flag() -> None:
    limb = Limb(range_rad=0.6)
    model = limb.fit("anchored")
    assert isinstance(model, KernelModel)
    inside = model.predict_one(
        [as_quaternion(q[100]) for q in limb.sensors], as_quaternion(limb.other[100])
    )
    still: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    far = model.predict_one([still, still], as_quaternion(rot.exp([2.5, 0.8, 1.0])))
    assert not inside.extrapolating
    assert far.extrapolating
    assert far.sd > 1.3 * inside.sd
    assert rot.angle_between(far.q, still) < 0.4 * np.sqrt(3.0) * 0.9


def test_without_the_neighbor_the_anchored_model_is_the_mean() -> None:
    """Without the orientation of the neighboring segment, the model returns the sensor mean."""
    limb = Limb()
    model = limb.fit("anchored")
    assert isinstance(model, KernelModel)
    alone = model.predict_one([as_quaternion(q[200]) for q in limb.sensors])
    assert alone.sd == model.mean_sd > model.residual_sd
    assert rot.angle_between(alone.q, model.predict(limb.sensors)[200]) < 1e-12
    untaught = fit_segment("anchored", limb.sensors, None, limb.segment)
    assert isinstance(untaught, MeanModel)


def test_predicted_deviation_matches_the_errors_of_later_frames() -> None:
    limb = Limb()
    for method in METHODS:
        model = limb.fit(method)
        real = limb.error(model) / np.sqrt(3.0)
        assert 0.4 * real < model.residual_sd < 2.5 * real, method


def test_axes_are_claimed_apart_and_together() -> None:
    """The total standard deviation is the RMS of the standard deviations about the axes."""
    limb = Limb()
    model = limb.fit("anchored")
    said = model.predict_one(
        [as_quaternion(q[100]) for q in limb.sensors], as_quaternion(limb.other[100])
    )
    assert said.axis_sd is not None
    assert np.sqrt(np.mean(np.square(said.axis_sd))) == pytest.approx(said.sd)


def test_model_without_information_is_the_mean() -> None:
    """If errors do not depend on posture, the error exceeds that of the mean by at most 2 %."""
    rng = np.random.default_rng(3)
    limb = Limb()
    limb.sensors = [
        rot.multiply(limb.segment, rot.exp(rng.normal(0, 0.02, (N, 3)))) for _ in range(2)
    ]
    labels = np.arange(N) // 150
    model = fit_segment("anchored", limb.sensors, limb.other, limb.segment, labels)
    mean = fit_segment("mean", limb.sensors, limb.other, limb.segment)
    assert limb.error(model, slice(0, N)) < 1.02 * limb.error(mean, slice(0, N))


def test_patent6_shares_the_coefficients_and_patent12_does_not() -> None:
    limb = Limb()
    shared, separate = limb.fit("patent6"), limb.fit("patent12")
    assert isinstance(shared, PatentModel)
    assert isinstance(separate, PatentModel)
    assert len({row[:-1] for row in shared.coefficients}) == 1
    assert len({row[:-1] for row in separate.coefficients}) == 4
    assert len({row[-1] for row in shared.coefficients}) == 4


def test_the_patent_finds_coefficients_that_were_put_in() -> None:
    # The reference is a known function of the sensors, so least squares must return this function.
    limb = Limb()
    x, y = (rot.align_hemisphere(q, limb.segment[0]) for q in limb.sensors)
    target = rot.normalize(0.7 * x + 0.3 * y)
    scale = np.linalg.norm(0.7 * x + 0.3 * y, axis=1)
    assert np.ptp(scale) < 0.02
    model = fit_segment("patent6", [x, y], None, target)
    assert isinstance(model, PatentModel)
    assert model.coefficients[0][:2] == pytest.approx((0.7, 0.3), abs=0.02)


def test_a_regression_that_gives_no_rotation_leaves_the_mean() -> None:
    """If the regression result is far from unit length, the model returns the sensor mean."""
    limb = Limb()
    fitted = limb.fit("patent12")
    assert isinstance(fitted, PatentModel)
    dead = PatentModel("patent12", ((0.0, 0.0, 0.1),) * 4, fitted.q_sign, 0.1, 1)
    sensors = [as_quaternion(q[0]) for q in limb.sensors]
    said = dead.predict_one(sensors)
    assert said.extrapolating
    assert rot.angle_between(said.q, rot.average(np.array(sensors))) < 1e-9
    assert rot.angle_between(dead.predict(limb.sensors)[0], said.q) < 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_unknown_frames_are_left_out_of_the_fit_and_unknown_in_the_answer(method: Method) -> None:
    limb = Limb()
    holes = [q.copy() for q in limb.sensors]
    holes[1][50:90] = np.nan
    model = fit_segment(method, holes, limb.other, limb.segment)
    kept = np.r_[0:50, 90:N]
    whole = fit_segment(
        method, [q[kept] for q in limb.sensors], limb.other[kept], limb.segment[kept]
    )
    assert model == whole
    assert np.isnan(model.predict(holes, limb.other)[60]).all()


def test_too_few_frames_are_rejected() -> None:
    limb = Limb()
    with pytest.raises(ValueError, match="12 complete frames"):
        limb.fit("mean", slice(0, 12))
    with pytest.raises(ValueError, match="at least one sensor"):
        fit_segment("mean", [], None, limb.segment)


def test_hold_out_blocks_are_contiguous_and_cover_each_frame_once() -> None:
    limb = Limb()
    for labels, blocks in ((np.zeros(N, int), 5), (np.arange(N) // 300, 6)):
        training = SegmentTraining.of(limb.sensors, limb.other, limb.segment, labels)
        folds = list(training.folds())
        assert len(folds) == blocks
        assert np.array_equal(np.sum(folds, axis=0), np.ones(N))
        assert all(np.count_nonzero(np.diff(f.astype(int))) <= 2 for f in folds)
