"""The kernel correction with bad input: each case yields an error message or a fit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.calibration.record._content_check import _wrong_types
from jointfit_daemon.calibration.soft_tissue import SegmentTraining
from jointfit_daemon.calibration.soft_tissue._kernel_fit import fit_kernel
from jointfit_daemon.calibration.soft_tissue._kernel_ridge import stacking_weights
from jointfit_daemon.calibration.soft_tissue._kernel_trend_fit import fit_trend
from jointfit_daemon.calibration.soft_tissue._leverage_variance_fit import measure_spread
from jointfit_daemon.kinematics import rotation as rot
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import KernelModel, trend
from jointfit_daemon.limb_model._kernel_expert import LARGEST
from jointfit_variant import running_variant

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

N = 500
DEG = np.deg2rad(1.0)


class Knee:
    """A thigh with two sensors and a shank; the soft-tissue artefact follows flexion."""

    def __init__(self, seed: int = 1, bend: float = 1.2) -> None:
        rng = np.random.default_rng(seed)
        t = np.linspace(0.0, 25.0, N)
        angle = bend * (0.5 - 0.5 * np.cos(1.1 * t))
        joint = np.column_stack([-angle, 0.1 * np.sin(t), 0.1 * np.sin(0.6 * t)])
        lean = np.column_stack([0.4 * np.sin(0.8 * t), 0.1 * np.cos(t), 0.2 * np.sin(0.3 * t)])
        self.bone = rot.exp(lean)
        self.other = rot.multiply(self.bone, rot.exp(joint))
        self.sensors = [
            rot.multiply(self.bone, rot.exp(joint @ skin + rng.normal(0, 0.3 * DEG, (N, 3))))
            for skin in rng.normal(0.05, 0.06, (2, 3, 3))
        ]

    def training(self, frames: slice = slice(None)) -> SegmentTraining:
        return SegmentTraining.of(
            [q[frames] for q in self.sensors], self.other[frames], self.bone[frames]
        )

    def error(self, said: Array, frames: slice | NDArray[np.bool_] = slice(None)) -> float:
        return float(np.sqrt(np.mean(rot.angle_between(said, self.bone[frames]) ** 2)))


def test_data_without_movement_leaves_the_mean_as_it_is() -> None:
    """Without knee movement, the error is at most 5 % larger than the error of the sensor mean."""
    knee = Knee(bend=0.0)
    rng = np.random.default_rng(4)
    for i in (0, 1):
        knee.sensors[i] = rot.multiply(knee.bone, rot.exp(rng.normal(0, 0.5 * DEG, (N, 3))))
    knee.other = knee.bone
    model = fit_kernel(knee.training())
    mean = rot.exp(0.5 * rot.log(rot.multiply(rot.conjugate(knee.sensors[0]), knee.sensors[1])))
    assert knee.error(model.predict(knee.sensors, knee.other)) < 1.05 * knee.error(
        rot.multiply(knee.sensors[0], mean)
    )


def test_sensors_that_are_one_and_the_same_still_give_a_fit() -> None:
    knee = Knee()
    knee.sensors[1] = knee.sensors[0].copy()
    model = fit_kernel(knee.training(slice(0, 300)))
    late = slice(300, N)
    said = model.predict([q[late] for q in knee.sensors], knee.other[late])
    assert np.isfinite(said).all()
    assert knee.error(said, late) < 0.7 * knee.error(knee.sensors[0][late], late)


def test_a_reference_missing_half_of_the_time_is_left_out_not_guessed() -> None:
    knee = Knee()
    whole = fit_kernel(knee.training())
    hidden = knee.bone.copy()
    hidden[(np.arange(N) // 25) % 2 == 1] = np.nan
    half = fit_kernel(SegmentTraining.of(knee.sensors, knee.other, hidden))
    errors = [knee.error(model.predict(knee.sensors, knee.other)) for model in (whole, half)]
    assert errors[1] < 1.2 * errors[0]


def test_signs_of_quaternions_mixed_at_random_change_nothing() -> None:
    knee = Knee()
    rng = np.random.default_rng(7)

    def flipped(q: Array) -> Array:
        signs: Array = rng.choice([-1.0, 1.0], (len(q), 1))
        return q * signs

    mixed = SegmentTraining.of(
        [flipped(q) for q in knee.sensors], flipped(knee.other), flipped(knee.bone)
    )
    straight, other = fit_kernel(knee.training()), fit_kernel(mixed)
    a = straight.predict(knee.sensors, knee.other)
    b = other.predict([flipped(q) for q in knee.sensors], flipped(knee.other))
    assert np.max(rot.angle_between(a, b)) < 1e-6


def test_a_sensor_unplugged_during_calibration_leaves_too_little_and_is_refused() -> None:
    knee = Knee()
    knee.sensors[1][20:] = np.nan
    with pytest.raises(ValueError, match=r"20 complete frames; at least 30"):
        knee.training()


def test_a_sensor_unplugged_for_a_while_costs_those_frames_only() -> None:
    knee = Knee()
    knee.sensors[1] = knee.sensors[1].copy()
    knee.sensors[1][100:200] = np.nan
    assert len(knee.training()) == N - 100
    model = fit_kernel(knee.training())
    seen = slice(200, N)
    said = model.predict([q[seen] for q in knee.sensors], knee.other[seen])
    assert knee.error(said, seen) < 1.2 * DEG


def test_the_heading_of_a_person_changes_nothing() -> None:
    knee = Knee()
    model = fit_kernel(knee.training())
    straight = model.predict(knee.sensors, knee.other)
    for degrees in (30.0, 90.0, 180.0):
        turn = rot.heading(degrees * DEG)
        turned = model.predict(
            [rot.multiply(turn, q) for q in knee.sensors], rot.multiply(turn, knee.other)
        )
        assert np.max(rot.angle_between(turned, rot.multiply(turn, straight))) < 1e-9


def test_the_claim_grows_outside_of_the_training() -> None:
    """The predicted standard deviation is larger outside the training range than inside."""
    model = fit_kernel(Knee().training())
    inside, outside = model.spread.at(0.5), model.spread.at(10.0)
    assert all(far > 1.4 * near for near, far in zip(inside, outside, strict=True))


def test_errors_beyond_the_training_are_claimed_larger_than_shown() -> None:
    """At larger leverage ratios than those of the residuals, the predicted error exceeds them."""
    rng = np.random.default_rng(2)
    near = measure_spread([rng.uniform(0, 1, 900)], [rng.normal(0, 0.02, (900, 3))], np.ones(900))
    within = np.array(near.at(0.5))
    assert np.all((within > 0.014) & (within < 0.026))
    assert np.all(np.array(near.at(2.0)) > 1.5 * within)

    # The fit assumes an error of three times the RMS residual at the leverage ratio 1.5.
    ratios = np.array(near.at(1.5)) / within
    assert np.all((ratios > 2.4) & (ratios < 3.0))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_long_pauses_in_the_training_hardly_change_the_error_in_movement(seed: int) -> None:
    """With pauses that last 17 times as long as the movement, the error grows by at most 30 %."""
    knee, rng = Knee(seed), np.random.default_rng(seed)
    movement, pause = 60, 1000
    columns = (*knee.sensors, knee.other, knee.bone)
    bends = np.abs(rot.log(rot.multiply(rot.conjugate(knee.bone[:300]), knee.other[:300]))[:, 0])
    straight = int(np.argmin(bends))

    sensors_and_bones = []
    for q in columns:
        rests = [
            rot.multiply(q[straight], rot.exp(rng.normal(0, 0.2 * DEG, (pause, 3))))
            for _ in range(5)
        ]
        moves = np.split(q[:300], range(movement, 300, movement))
        pairs = [part for pair in zip(moves, rests, strict=True) for part in pair]
        sensors_and_bones.append(np.concatenate(pairs))
    *sensors, other, bone = sensors_and_bones

    late = slice(300, N)
    errors = [
        knee.error(model.predict([q[late] for q in knee.sensors], knee.other[late]), late)
        for model in (
            fit_kernel(knee.training(slice(0, 300))),
            fit_kernel(SegmentTraining.of(sensors, other, bone)),
        )
    ]
    assert errors[1] < 1.3 * errors[0]


def test_stacked_shares_are_a_part_of_a_whole() -> None:
    """Stacking weights are not negative, have a sum of at most 1, and prefer good predictions."""
    rng = np.random.default_rng(3)
    truth = rng.normal(0, 1, 200)
    predictions = np.stack([truth + rng.normal(0, 0.1, 200), rng.normal(0, 1, 200)], axis=1)
    shares = stacking_weights(predictions, truth)
    assert np.all(shares >= 0)
    assert shares.sum() <= 1.001
    assert shares[0] > 0.9
    assert np.all(stacking_weights(predictions, rng.normal(0, 1, 200)) < 0.2)


def test_one_frame_is_that_of_many_wherever_it_lies() -> None:
    """The prediction for one frame equals its row in the prediction for all frames."""
    knee = Knee()
    model = fit_kernel(knee.training(slice(0, 120)))
    many = model.predict(knee.sensors, knee.other)
    for i in range(0, N, 17):
        one = model.predict_one(
            [as_quaternion(q[i].tolist()) for q in knee.sensors],
            as_quaternion(knee.other[i].tolist()),
        )
        assert rot.angle_between(one.q, many[i]) < 1e-9


def test_constant_offset_is_corrected_far_outside_the_training_range() -> None:
    """Sensors with a constant offset of 5 deg are corrected, also outside the training range."""
    off = rot.exp(np.array([4.0 * DEG, -3.0 * DEG, 0.0]))
    near, far = Knee(bend=0.6), Knee(bend=2.4)
    for knee in (near, far):
        knee.sensors = [rot.multiply(knee.bone, off) for _ in knee.sensors]
    model = fit_kernel(near.training())
    deep = np.abs(rot.log(rot.multiply(rot.conjugate(far.bone), far.other))[:, 0]) > 1.6
    assert deep.sum() > 100
    said = model.predict([q[deep] for q in far.sensors], far.other[deep])
    assert far.error(said, deep) < 2.0 * DEG
    assert far.error(far.sensors[0][deep], deep) > 4.5 * DEG


def test_a_trend_of_constant_and_weights_is_found_and_bounded() -> None:
    """The trend is a constant plus linear terms. Outliers hardly change it, and it has a limit."""
    rng = np.random.default_rng(5)
    u = rng.normal(0, 0.3, (400, 9))
    u[:, 6:] = rng.normal(0, 0.01, (400, 3))
    rho = np.zeros((400, 3))
    rho[:, 0] = 0.05 + 0.4 * u[:, 3]
    rho[:, 1] = -0.02 - 0.3 * u[:, 4]
    rho[:, 2] = 0.3
    rho[::10] += rng.normal(0, 0.5, (40, 3))
    rows = fit_trend(u, rho, np.ones(400))
    clean = np.ones(400, dtype=bool)
    clean[::10] = False
    found = trend(rows, u)
    assert np.max(np.abs(found - rho)[clean, :2]) < 0.012
    assert np.all(found[:, 2] == 0.0)
    assert np.max(np.abs(trend(rows, 100.0 * u))) == LARGEST


def test_a_stored_model_with_wrong_types_is_found_wherever_they_are() -> None:
    data = fit_kernel(Knee().training()).to_dict()
    assert [*_wrong_types(KernelModel.read(data))] == []

    data["mean_sd"] = {}
    assert {*_wrong_types(KernelModel.read(data))} == {"mean_sd"}
    data["tilted"] |= {"tilted": "yes", "carried": ["", 1.0, 1.0]}
    if running_variant() == "compiled":  # compiled functions check their arguments themselves
        with pytest.raises(TypeError, match="bool object expected"):
            KernelModel.read(data)
        return
    found = {*_wrong_types(KernelModel.read(data))}
    assert found == {"mean_sd", "tilted.tilted", "tilted.carried"}


def test_trial_with_much_upright_standing_is_fitted() -> None:
    """One fold of the cross-validation holds out all moving frames; the rest is one posture."""
    knee = Knee()
    for q in (*knee.sensors, knee.other, knee.bone):
        q[100:] = (1.0, 0.0, 0.0, 0.0)
    model = fit_kernel(knee.training())
    said = model.predict(knee.sensors, knee.other)
    assert knee.error(said) < 0.9 * knee.error(knee.sensors[0])
    assert np.isfinite((*model.spread.inside, *model.spread.outside)).all()


def test_correction_is_zero_in_the_static_pose_for_any_training() -> None:
    """The constant term of the trend is not applied in the static pose."""
    knee = Knee(bend=2.0)
    off = rot.exp(np.array([4.0 * DEG, -3.0 * DEG, 0.0]))
    knee.sensors = [rot.multiply(q, off) for q in knee.sensors]
    deep = np.abs(rot.log(rot.multiply(rot.conjugate(knee.bone), knee.other))[:, 0]) > 0.7
    taught = SegmentTraining.of([q[deep] for q in knee.sensors], knee.other[deep], knee.bone[deep])
    model = fit_kernel(taught)
    assert np.max(np.abs(np.array(model.trend)[:, 0])) > 1.0 * DEG
    straight = rot.IDENTITY[None, :]
    said = model.predict([straight, straight], straight)
    assert rot.angle_between(said, straight)[0] < 1e-9
    one = model.predict_one([(1.0, 0.0, 0.0, 0.0)] * 2, (1.0, 0.0, 0.0, 0.0))
    assert rot.angle_between(one.q, straight[0]) < 1e-9
    assert not one.extrapolating
