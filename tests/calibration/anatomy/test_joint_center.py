"""Joint centers of simulated movements: errors, covariance, and undetermined directions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.subjects.noisy_bodies import FRAMES, Subject
from jointfit_daemon.calibration.anatomy import on_skin
from jointfit_daemon.calibration.anatomy._joint_center import (
    align_vertically,
    fit_center,
    joint_center,
)
from jointfit_daemon.calibration.anatomy._marker_clusters import ClusterTrack
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation import BodyPoses

CHILD = np.array([[0.05, 0, -0.25], [-0.04, 0.05, -0.3], [0, -0.06, -0.2], [0.06, 0.04, -0.32]])
CENTER = np.array([0.1, -0.2, 0.9])
SIDE = np.array([1.0, -1.0, 0.75])


def ball(rng: np.random.Generator, arc_deg: float, n: int = 200, sigma: float = 1e-3) -> Array:
    """Return markers of a ball joint that moves in all directions, in the parent's frame, m."""
    h = np.radians(arc_deg) / 2
    a, phi = h * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    vectors = np.stack((a * np.cos(phi), a * np.sin(phi), rng.uniform(-h, h, n)), axis=1)
    turned = np.einsum("nij,kj->nki", Rotation.from_rotvec(vectors).as_matrix(), CHILD)
    return np.asarray(CENTER + turned + rng.normal(0, sigma, turned.shape))


def hinge(
    rng: np.random.Generator, arc_deg: float, axis: Array, n: int = 600, sigma: float = 1e-3
) -> Array:
    angle = np.radians(arc_deg) * (0.5 - 0.5 * np.cos(np.linspace(0, 6 * np.pi, n)))
    turned = np.einsum(
        "nij,kj->nki", Rotation.from_rotvec(angle[:, None] * np.asarray(axis)).as_matrix(), CHILD
    )
    return np.asarray(CENTER + turned + rng.normal(0, sigma, turned.shape))


def information_bound(points: Array, sigma: float) -> float:
    """Return the Cramér-Rao bound of the RMS error of the center, with unknown radii, m."""
    d = points - CENTER
    u = d / np.linalg.norm(d, axis=-1, keepdims=True)
    n, k, _ = u.shape
    rows = np.zeros((n * k, 3 + k))
    rows[:, :3] = u.reshape(-1, 3)
    rows[np.arange(n * k), 3 + np.tile(np.arange(k), n)] = 1.0
    return float(np.sqrt(np.trace(np.linalg.inv(rows.T @ rows)[:3, :3])) * sigma)


@pytest.mark.parametrize("arc", [45, 90])
def test_joint_center_error_is_near_the_cramer_rao_bound_and_matches_its_covariance(
    arc: float,
) -> None:
    rng = np.random.default_rng(1)
    errors, claimed, bounds = [], [], []
    for _ in range(40):
        points = ball(rng, arc)
        found = fit_center(points, CENTER + 0.03)
        assert found.refused is None
        assert len(found.unseen) == 0
        errors.append(((found.center - CENTER) ** 2).sum())
        claimed.append(np.trace(found.covariance))
        bounds.append(information_bound(points, 1e-3) ** 2)
    assert np.sqrt(np.mean(errors) / np.mean(bounds)) < 1.25
    assert 0.75 < np.sqrt(np.mean(claimed) / np.mean(errors)) < 1.35


def test_a_distant_start_gives_the_same_center() -> None:
    points = ball(np.random.default_rng(2), 60)
    near, far = fit_center(points, CENTER), fit_center(points, CENTER + 0.2 * SIDE)
    assert np.allclose(near.center, far.center, atol=1e-5)


def test_the_center_of_a_hinge_is_undetermined_along_the_axis_only() -> None:
    rng = np.random.default_rng(3)
    axis = np.array([0.9, 0.3, -0.1]) / np.linalg.norm([0.9, 0.3, -0.1])
    start = CENTER + 0.07 * axis + 0.05 * np.array([0, 0, 1])
    found = fit_center(hinge(rng, 70, axis, sigma=3e-3), start)
    assert len(found.unseen) == 1
    assert abs(found.unseen[0] @ axis) > 0.998
    off = found.center - CENTER
    assert np.linalg.norm(off - axis * (axis @ off)) < 3e-3
    moved = align_vertically(found, CENTER[:2])
    assert np.linalg.norm(moved.center - CENTER) < 3e-3
    assert np.sqrt(axis @ on_skin(found) @ axis) == pytest.approx(0.03, rel=0.05)


def test_markers_that_never_move_are_refused() -> None:
    still = np.tile(np.array([0.0, 1.0, 0.0]), (60, 2, 1))
    for start in (np.zeros(3), np.array([0.0, 0.5, 0.0]), still[0, 0]):
        assert fit_center(still, start).refused is not None


def test_one_marker_torn_off_and_gaps_move_the_center_little() -> None:
    rng = np.random.default_rng(4)
    points = ball(rng, 80, n=400)
    points[rng.uniform(size=points.shape[:2]) < 0.2] = np.nan
    points[100:130, 0] += [0.08, 0.0, 0.05]
    assert np.linalg.norm(fit_center(points, CENTER + 0.05).center - CENTER) < 2e-3


@pytest.mark.parametrize(
    ("points", "reason"),
    [(np.full((200, 4, 3), np.nan), "usable frames"), (np.ones((200, 4, 3)), "turned")],
)
def test_no_movement_is_refused_with_the_reason(points: Array, reason: str) -> None:
    found = fit_center(points, CENTER)
    assert found.refused is not None
    assert reason in found.refused


def track(poses: BodyPoses, points: Array) -> ClusterTrack:
    t_ns = np.arange(FRAMES)
    return ClusterTrack(t_ns, poses.q, poses.t, points, np.zeros(FRAMES), np.zeros(3))


def test_noise_of_both_clusters_does_not_bias_the_calibrated_center() -> None:
    sphere, calibrated = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        person = Subject.random(rng, 4)
        seen = person.observe(rng, 20.0, 1e-3)
        assert seen.parent is not None
        assert seen.child is not None
        assert seen.points is not None
        markers = np.broadcast_to(person.parent, (FRAMES, 4, 3))
        above = track(seen.parent, rotation.rotate(seen.parent.q[:, None], markers))
        above.points[:] += seen.parent.t[:, None]
        world = rotation.rotate(seen.parent.q[:, None], seen.points) + seen.parent.t[:, None]
        below = track(seen.child, world)
        start = np.array([0.0, 0.0, 0.01])
        sphere.append(fit_center(above.to_static(world), start).center)
        found = joint_center(above, below, start)
        assert found.refused is None
        assert found.leverage is not None
        calibrated.append(found.center)

    assert np.sqrt(np.mean(np.square(calibrated).sum(axis=1))) < 3e-3
    assert np.sqrt(np.mean(np.square(sphere).sum(axis=1))) > 8e-3
