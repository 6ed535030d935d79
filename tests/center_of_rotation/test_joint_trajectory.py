"""Joint positions over time from centers in segment frames, compared with simulated truth."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.center_of_rotation import (
    BodyPoses,
    JointSide,
    estimate_center,
    joint_trajectory,
    refusal,
)
from jointfit_daemon.center_of_rotation.planar import planar_noise, plane_of
from jointfit_daemon.center_of_rotation.spatial import spatial_noise

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

FRAMES = 60
PARENT = np.array([[-0.1, 0.02], [0.1, -0.02]])
CENTER = np.array([0.25, 0.05])
BASIS = plane_of((1.0, 0.0, 0.0))


def turned(angle: Array, point: Any) -> Array:
    """Return a point of the plane, rotated by each angle."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack((c * point[0] - s * point[1], s * point[0] + c * point[1]), axis=-1)


def planar_side(rng: np.random.Generator, noise: float) -> tuple[JointSide, Array]:
    """Return one side of a planar joint with two noisy markers, and the true joint positions."""
    t = np.linspace(0.0, 1.0, FRAMES)
    angle, bend = 0.5 * np.sin(9.0 * t), 1.2 * np.sin(5.0 * t)
    at = np.stack((t, 0.3 * t), axis=1)
    p, q = (at + turned(angle, m) + rng.normal(0.0, noise, (FRAMES, 2)) for m in PARENT)
    truth = at + turned(angle, CENTER)
    child = truth + turned(angle + bend, (0.3, 0.1)) + rng.normal(0.0, noise, (FRAMES, 2))

    along, middle = q - p, (p + q) / 2
    slope = np.arctan2(*(PARENT[1] - PARENT[0])[::-1])
    found = np.arctan2(along[:, 1], along[:, 0]) - slope
    seen = np.stack([turned(-a, x) for a, x in zip(found, child - middle, strict=True)])
    gap = (np.linalg.norm(along, axis=1) - np.linalg.norm(PARENT[1] - PARENT[0])) / 2
    poses = BodyPoses(
        np.stack((np.cos(found / 2), np.sin(found / 2), 0.0 * t, 0.0 * t), axis=1),
        middle @ BASIS.T,
    )
    rms = float(np.sqrt((gap**2).mean()))
    return JointSide(poses, BASIS, PARENT, rms, estimate_center(seen, "hyper")), truth @ BASIS.T


def test_the_predicted_error_of_a_planar_joint_is_the_error_that_occurs() -> None:
    runs = [planar_side(np.random.default_rng(seed), 0.001) for seed in range(60)]
    found = [(joint_trajectory([side], FRAMES), truth) for side, truth in runs]
    occurred = np.mean([((track.positions - truth) ** 2).sum(axis=1) for track, truth in found])
    predicted = np.mean([track.error**2 for track, _ in found])
    assert np.sqrt(occurred / predicted) == pytest.approx(1.0, abs=0.15)


def spatial_side(center: Any, q: Array, t: Array, **fields: Any) -> JointSide:
    """Return a segment of four markers without noise, with a given center."""
    markers = 0.1 * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    estimate = estimate_center(np.zeros((1, 1, 3)), "sphere")
    estimate = replace(
        estimate, center=np.asarray(center), refused=None, unseen=np.zeros((0, 3)), residual=0.0
    )
    return JointSide(BodyPoses(q, t), np.eye(3), markers, 0.0, replace(estimate, **fields))


def poses(seed: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    q = Rotation.random(FRAMES, random_state=seed).as_quat()[:, [3, 0, 1, 2]]
    return q, rng.normal(size=(FRAMES, 3))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.lists(st.booleans(), min_size=FRAMES, max_size=FRAMES))
def test_only_frames_without_a_pose_of_either_segment_are_gaps(
    seed: int, hidden: list[bool]
) -> None:
    q, t = poses(seed)
    lost = np.array(hidden)
    q[lost] = np.nan
    one = spatial_side((0.1, 0.0, 0.2), q, t)
    assert (np.isnan(joint_trajectory([one], FRAMES).positions).all(axis=1) == lost).all()

    whole, at = poses(seed + 1)
    second = spatial_side((0.1, 0.0, 0.2), whole, at)
    assert np.isfinite(joint_trajectory([one, second], FRAMES).positions).all()


def test_a_refused_center_has_no_positions_and_the_other_side_is_used() -> None:
    q, t = poses(1)
    good = spatial_side((0.1, 0.0, 0.2), q, t)
    bad = replace(good, estimate=refusal("sphere", 3, FRAMES, "at rest: move"))
    none = joint_trajectory([bad], FRAMES)
    assert np.isnan(none.positions).all()
    assert np.isnan(none.error).all()
    expected = good.poses.to_world(np.array([0.1, 0.0, 0.2]))
    np.testing.assert_allclose(joint_trajectory([bad, good], FRAMES).positions, expected)


def test_sides_that_disagree_increase_the_error() -> None:
    q, t = poses(2)
    small = 1e-6 * np.eye(3)
    first = spatial_side((0.1, 0.0, 0.2), q, t, covariance=small)
    agreeing = joint_trajectory([first, first], FRAMES)
    far = spatial_side((0.1, 0.0, 0.23), q, t, covariance=small)
    disagreeing = joint_trajectory([first, far], FRAMES)
    assert agreeing.sides_apart == pytest.approx(0.0, abs=1e-12)
    assert agreeing.error == pytest.approx(np.sqrt(3e-6))
    assert disagreeing.sides_apart == pytest.approx(0.03)
    assert disagreeing.error.min() > 0.015 / 1.3


def test_a_direction_that_one_side_did_not_observe_is_that_of_the_other() -> None:
    q, t = poses(3)
    axis = np.array([[0.0, 0.0, 1.0]])
    blind = spatial_side((0.1, 0.0, 0.9), q, t, unseen=axis)
    seeing = spatial_side((0.1, 0.0, 0.2), q, t)
    expected = seeing.poses.to_world(np.array([0.1, 0.0, 0.2]))
    found = joint_trajectory([blind, seeing], FRAMES)
    np.testing.assert_allclose(found.positions, expected, atol=1e-12)


def test_motion_beyond_the_noise_of_the_markers_is_part_of_the_error() -> None:
    q, t = poses(4)
    rigid = joint_trajectory([spatial_side((0.1, 0.0, 0.2), q, t)], FRAMES)
    loose = joint_trajectory([spatial_side((0.1, 0.0, 0.2), q, t, residual=0.004)], FRAMES)
    assert rigid.error == pytest.approx(0.0, abs=1e-9)
    assert loose.error == pytest.approx(0.004 * np.sqrt(3.0))


def test_planar_noise_is_that_of_simulated_markers() -> None:
    rng = np.random.default_rng(1)
    n, noise, apart, at = 100_000, 0.001, 0.2, np.array([0.05, 0.3])
    p, q, m = (v + rng.normal(0, noise, (n, 2)) for v in ((-apart / 2, 0), (apart / 2, 0), at))
    along = (q - p) / np.linalg.norm(q - p, axis=1, keepdims=True)
    d = m - (p + q) / 2
    local = np.stack(
        ((along * d).sum(axis=1), along[:, 0] * d[:, 1] - along[:, 1] * d[:, 0]), axis=1
    )
    expected = planar_noise(at, np.array([[-apart / 2, 0.0], [apart / 2, 0.0]]), noise)
    assert np.cov(local.T) == pytest.approx(expected, rel=0.05, abs=2e-8)


def test_planar_noise_is_spatial_noise_for_rotation_about_one_axis() -> None:
    flat = np.array([[0.1, 0.0], [-0.1, 0.0], [0.0, 0.1], [0.0, -0.1]])
    raised = np.column_stack((flat, np.zeros(4)))
    in_space = spatial_noise(np.array([0.2, 0.3, 0.0]), raised, 0.001)
    assert in_space[:2, :2] == pytest.approx(planar_noise(np.array([0.2, 0.3]), flat, 0.001))
    with pytest.raises(ValueError, match="two markers at different positions: move one"):
        planar_noise(np.zeros(2), np.zeros((2, 2)), 0.001)
