"""Sphere fits of segments at rest and with soft-tissue artefact."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.stats import f as fisher

from bench.subjects.simulated_joints import CHILD, PARENT, ball_turns, hinge_turns, watched
from jointfit_daemon.center_of_rotation import Movement, estimate_center
from jointfit_daemon.center_of_rotation.spatial import (
    SphereLimits,
    fit_running,
    fit_sphere,
    turn_noise,
)
from jointfit_daemon.center_of_rotation.spatial._observability import posture_share, within95
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import rigid_fit

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

AT_REST = np.tile(np.eye(3), (200, 1, 1))


@pytest.mark.parametrize("noise", [1e-4, 5e-4, 2e-3])
@pytest.mark.parametrize("name", ["sphere", "running_sphere", "halvorsen", "score", "sara"])
def test_a_child_at_rest_in_a_noisy_parent_is_refused(name: str, noise: float) -> None:
    for seed in range(12):
        seen = watched(np.random.default_rng(seed), AT_REST, noise=noise)
        found = estimate_center(Movement(seen.points, seen.parent, seen.child), name)
        assert found.refused is not None
        assert "move" in found.refused


def test_rotations_of_a_loose_parent_are_no_joint_rotations() -> None:
    """Marker noise rotates the frame of a small parent cluster, although the joint is at rest."""
    believed = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        loose = 0.3 * PARENT
        seen = watched(rng, AT_REST, noise=4e-3, frame=loose)
        told = Movement(seen.points, seen.parent, seen.child)
        believed += estimate_center(told, "sphere").refused is None
        known = Movement(seen.points, seen.parent, seen.child, loose)
        found = estimate_center(known, "sphere")
        assert found.refused is not None
    assert believed >= 3, "the test is useless: without the known frame, points are refused, too"


def test_the_rotation_noise_of_a_parents_frame_agrees_with_simulation() -> None:
    rng = np.random.default_rng(1)
    seen = PARENT + rng.normal(0, 1e-3, (20_000, *PARENT.shape))
    q = rigid_fit(PARENT, seen)[0]
    turns = rotation.log(q)
    loosest = float(np.sqrt(np.linalg.eigvalsh(np.cov(turns.T))[-1]))
    assert turn_noise(PARENT, 1e-3) == pytest.approx(loosest, rel=0.03)


def on_skin(seed: int, cycles: int = 4) -> Array:
    """Return the markers of a knee with soft-tissue artefact, m; the center is the origin."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0.0, 2.0 * np.pi * cycles, 100 * cycles)
    flexion = np.radians(35.0) * np.sin(s)
    turns = rotation.to_matrix(rotation.exp(flexion[:, None] * np.array([1.0, 0.0, 0.0])))
    ways = rng.normal(0, 0.004, (3, 4, 3))
    waves = np.stack((np.sin(s), np.cos(2 * s), np.sin(3 * s)), axis=1)
    slid = CHILD + np.einsum("tw,wkc->tkc", waves, ways)
    points = np.einsum("tij,tkj->tki", turns, slid)
    return np.asarray(points + rng.normal(0, 5e-4, points.shape))


def test_direction_shown_only_by_soft_tissue_artefact_is_unseen() -> None:
    misled = 0
    for seed in range(12):
        points = on_skin(seed)
        trusting = fit_sphere(points, limits=SphereLimits(posture=False))
        misled += bool(
            trusting.rms_error < inf and np.linalg.norm(trusting.center) > 3.0 * trusting.rms_error
        )
        found = fit_sphere(points)
        assert found.refused is not None or found.rms_error == inf
        assert "residuals_repeat" in found.flags
    assert misled >= 6, "the test is useless: without the check, the center is correct, too"


def test_predicted_error_with_soft_tissue_artefact_matches_actual_error() -> None:
    squares = []
    for seed in range(24):
        found = fit_sphere(on_skin(seed))
        across = np.linalg.svd(found.unseen)[2][len(found.unseen) :] if len(found.unseen) else None
        if across is None or found.refused is not None:
            continue
        e = across @ found.center
        C = across @ found.covariance @ across.T
        squares.append(float(e @ np.linalg.solve(C, e)) / len(e))
    assert len(squares) >= 12
    assert 0.2 < np.mean(squares) < 2.0


def test_refusal_for_soft_tissue_artefact_names_more_than_a_longer_arc() -> None:
    told = [found.refused for seed in range(24) if (found := fit_sphere(on_skin(seed))).refused]
    assert any("where the skin slides least" in why for why in told)
    clean = watched(np.random.default_rng(1), ball_turns(np.random.default_rng(1), 9.0))
    why = fit_sphere(clean.points).refused
    assert why is None or "skin" not in why


def test_repeated_cycles_do_not_reduce_soft_tissue_error() -> None:
    few, many = (fit_sphere(on_skin(3, cycles)) for cycles in (4, 40))
    assert np.trace(many.covariance) == pytest.approx(np.trace(few.covariance), rel=0.2)


def test_fading_noise_is_not_counted_as_soft_tissue_artefact() -> None:
    rng = np.random.default_rng(2)
    for rho in (0.0, 0.5):
        for _ in range(10):
            seen = watched(rng, ball_turns(rng, 45))
            e = rng.normal(0, 1e-3, seen.points.shape)
            for t in range(1, len(e)):
                e[t] = rho * e[t - 1] + np.sqrt(1 - rho**2) * e[t]
            assert "residuals_repeat" not in fit_sphere(seen.points + e).flags
    assert posture_share(0.06, 1e6) == 0.0
    assert posture_share(0.9, 100.0) == 0.9


@pytest.mark.parametrize("rank", [1, 2, 3])
@pytest.mark.parametrize("freedom", [20.0, 100.0, 5000.0])
def test_the_published_ellipse_has_the_quantile_of_its_freedom(rank: int, freedom: float) -> None:
    """The squared Mahalanobis radius is the 95 % quantile of the F distribution, times the rank."""
    exact = rank * float(fisher.ppf(0.95, rank, freedom))
    assert within95(rank, freedom) == pytest.approx(exact, rel=0.02)


def test_spatial_estimates_have_an_ellipse_size() -> None:
    rng = np.random.default_rng(4)
    for turns in (ball_turns(rng, 45), hinge_turns(45.0, axis=0)):
        seen = watched(rng, turns)
        movement = Movement(seen.points, seen.parent, seen.child, PARENT)
        for name in ("sphere", "running_sphere", "score"):
            found = estimate_center(movement, name)
            assert found.within95 is not None
            assert found.within95 > within95(3 - len(found.unseen), inf)


def test_running_sphere_excludes_soft_tissue_artefact_by_default() -> None:
    points = on_skin(5)
    assert "residuals_repeat" not in fit_running(points).flags
    assert "residuals_repeat" in fit_running(points, limits=SphereLimits()).flags
