"""Forward kinematics, compared with Monte-Carlo simulation; fading after a change of sensors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.fusion._forward_kinematics import (
    JointPlace,
    SegmentLength,
    joint_angle_estimate,
    joint_positions,
)
from jointfit_daemon.fusion._segment_fuser import FusedSegment, SegmentFuser, mean_one
from jointfit_daemon.limb_model import MeanModel, SegmentCalibration, model_key

if TYPE_CHECKING:
    from jointfit_daemon.model import Quaternion

REST: Quaternion = (1.0, 0.0, 0.0, 0.0)


def about_x(degrees: float) -> Quaternion:
    half = np.radians(degrees) / 2
    return (float(np.cos(half)), float(np.sin(half)), 0.0, 0.0)


def fused(r: Rotation, sd: float) -> FusedSegment:
    w, x, y, z = r.as_quat(scalar_first=True).tolist()
    return FusedSegment((w, x, y, z), sd, (), ())


def test_position_standard_deviations_match_monte_carlo() -> None:
    rng = np.random.default_rng(0)
    bones = [Rotation.from_rotvec([0.4, 0.1, -0.2]), Rotation.from_rotvec([-0.9, 0.2, 0.3])]
    sds, reaches = (0.03, 0.05), [SegmentLength(0.42, 0.006), SegmentLength(0.4, 0.01)]
    places = joint_positions(
        (0.1, 0.2, 0.9),
        [fused(r, sd) for r, sd in zip(bones, sds, strict=True)],
        reaches,
        [JointPlace(0), JointPlace(1)],
    )
    n, at = 40_000, np.array([0.1, 0.2, 0.9])
    for i, (bone, sd, reach) in enumerate(zip(bones, sds, reaches, strict=True)):
        errors = Rotation.from_rotvec(rng.normal(0, sd, (n, 3)))
        assert reach.length is not None
        length = rng.normal(reach.length, reach.sd, n)
        at = at + (bone * errors).apply(np.outer(length, [0, 0, -1.0]))
        place, variance = places[i + 1]
        assert place is not None
        assert np.allclose(place, at.mean(axis=0), atol=2e-3)
        assert variance == pytest.approx(at.var(axis=0).mean(), rel=0.03)


def test_flexion_standard_deviation_matches_monte_carlo() -> None:
    rng = np.random.default_rng(1)
    above, joint = Rotation.random(random_state=rng), Rotation.from_euler("XYZ", [-0.9, 0.5, 0.2])
    below, n = above * joint, 40_000
    state = joint_angle_estimate(fused(above, 0.02), fused(below, 0.03), sign=-1.0, left=False)
    assert state is not None
    assert state.angles == pytest.approx((0.9, 0.5, 0.2))
    noisy = [
        r * Rotation.from_rotvec(rng.normal(0, sd, (n, 3)))
        for r, sd in ((above, 0.02), (below, 0.03))
    ]
    flexion = -(noisy[0].inv() * noisy[1]).as_euler("XYZ")[:, 0]
    assert state.main_sd == pytest.approx(flexion.std(), rel=0.03)


def test_left_limb_mirrors_the_right_and_gimbal_lock_is_flagged() -> None:
    right = Rotation.from_euler("XYZ", [0.3, 0.2, 0.1])
    left = Rotation.from_euler("XYZ", [0.3, -0.2, -0.1])
    rest = fused(Rotation.identity(), 0.01)
    a = joint_angle_estimate(rest, fused(right, 0.01), sign=1.0, left=False)
    b = joint_angle_estimate(rest, fused(left, 0.01), sign=1.0, left=True)
    assert a is not None
    assert b is not None
    assert a.angles == pytest.approx(b.angles)
    locked = joint_angle_estimate(
        rest, fused(Rotation.from_euler("XYZ", [0.3, np.pi / 2, 0.1]), 0.01), sign=1.0, left=False
    )
    assert locked is not None
    assert (locked.gimbal, locked.main_sd) == (True, None)
    assert (
        joint_angle_estimate(rest, FusedSegment(None, None, (), ()), sign=1.0, left=False) is None
    )


def test_exchange_of_all_sensors_fades_over_250_ms() -> None:
    models = {model_key((s,), None): MeanModel((1.0,), 0.05) for s in ("A", "B")}
    fuser = SegmentFuser("thigh", ("A", "B"), SegmentCalibration(REST, None, None, models))
    assert fuser.fuse(0, {"A": REST}, ()).q == REST
    for after_ms, degrees in ((10, 0.0), (135, 5.0), (210, 8.0), (260, 10.0), (900, 10.0)):
        said = fuser.fuse(after_ms * 1_000_000, {"B": about_x(10.0)}, ())
        assert said.used == ("B",)
        assert said.q == pytest.approx(about_x(degrees), abs=1e-9)


@given(st.integers(0, 10_000), st.integers(2, 4))
def test_mean_equals_the_eigenvector_mean_for_any_signs(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    center = Rotation.random(random_state=rng)
    q = (center * Rotation.from_rotvec(rng.normal(0, 0.1, (count, 3)))).as_quat(scalar_first=True)
    signs = rng.choice([-1.0, 1.0], (count, 1))
    rows = [(float(w), float(x), float(y), float(z)) for w, x, y, z in q * signs]
    best = np.linalg.eigh(q.T @ q)[1][:, -1]
    said = np.array(mean_one(rows))
    off = 2 * np.arccos(min(1.0, abs(float(said @ best))))
    assert off < (1e-6 if count == 2 else 1e-2)
