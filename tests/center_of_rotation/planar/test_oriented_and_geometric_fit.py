"""Orientation-aided and geometric circle fits: errors, limits and degenerate input."""

from __future__ import annotations

from math import inf, nan
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bench.baselines.circle_theory import combine
from jointfit_daemon.center_of_rotation.planar import (
    AngleNoise,
    CircleLimits,
    circle_estimate,
    fit_circles,
    geometric_estimate,
    oriented_estimate,
)
from jointfit_daemon.center_of_rotation.planar._oriented_fit import limit_center

WIDE = CircleLimits(0.0, (0.0, inf), 0.0, inf)
values = st.one_of(st.floats(-1.0, 1.0), st.just(nan), st.just(0.0))


def arc(degrees: Any, n: int = 100, seed: int = 0, at: Any = 0.0, noise: float = 0.002) -> Any:
    rng = np.random.default_rng(seed)
    t = np.linspace(-0.5, 0.5, n) * np.deg2rad(degrees)
    p = 0.3 * np.stack((np.cos(t + at), np.sin(t + at)), axis=-1)
    return p + rng.normal(0.0, noise, p.shape), t


def rms(centers: Any) -> Any:
    return float(np.sqrt((np.array(centers) ** 2).sum(axis=1).mean()))


def test_angles_halve_the_error_of_a_short_arc() -> None:
    rng, aided, alone = np.random.default_rng(0), [], []
    for seed in range(60):
        p, t = arc(20.0, seed=seed)
        measured = t + np.deg2rad(1.0) * rng.normal(size=100)
        aided.append(oriented_estimate(p, measured, 0.02, limits=WIDE).center)
        alone.append(circle_estimate(p, limits=WIDE).center)
    assert rms(aided) < 0.65 * rms(alone)


def test_angles_of_another_limb_do_little_harm() -> None:
    """Angles that contradict the points increase the error of the circle fit by less than 25 %."""
    aided, alone, flagged = [], [], 0
    for seed in range(60):
        p, t = arc(60.0, seed=seed)
        found = oriented_estimate(p, 1.6 * t, 0.02, limits=WIDE)
        aided.append(found.center)
        alone.append(circle_estimate(p, limits=WIDE).center)
        flagged += "orientation_inconsistent" in found.flags
    assert rms(aided) < 1.25 * rms(alone)
    assert flagged > 50


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
@settings(max_examples=40, deadline=None)
def test_guard_limits_distance_from_the_circle_fit(x: Any, y: Any) -> None:
    circle = fit_circles(arc(90.0)[0])
    held, covariance, _ = limit_center(np.array([x, y]), circle.covariance * 0.1, circle)
    away = held - circle.center
    apart = np.linalg.inv(0.9 * circle.covariance)
    assert away @ apart @ away <= (0.7 * 1.05) ** 2
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()


def test_more_frames_than_needed_are_averaged() -> None:
    p, t = arc(60.0, n=1500)
    found = oriented_estimate(p, t, 0.01)
    assert found.refused is None
    assert np.linalg.norm(found.center) < 0.005


def test_angle_noise_of_the_caller_sets_the_uncertainty() -> None:
    p, t = arc(30.0, seed=1)
    t = t + 0.05 * np.random.default_rng(0).normal(size=100)
    sure = oriented_estimate(p, t, 0.02, noise=AngleNoise(0.001, 1.0, 0.06, 0.001), limits=WIDE)
    unsure = oriented_estimate(p, t, 0.02, noise=AngleNoise(0.2, 1.0, 0.2, 0.5), limits=WIDE)
    assert sure.rms_error < unsure.rms_error


@pytest.mark.parametrize(
    ("points", "angles", "cause"),
    [
        (np.full((50, 2), nan), np.linspace(0, 1, 50), "0 frames"),
        (np.ones((50, 2)), np.linspace(0, 1, 50), "no motion"),
        (arc(60.0)[0], np.zeros(100), "turned 0°"),
        (arc(60.0)[0], np.full(100, nan), "0 frames"),
    ],
)
def test_angles_without_a_movement_are_refused(points: Any, angles: Any, cause: Any) -> None:
    found = oriented_estimate(points, angles, 0.01)
    assert found.refused is not None
    assert cause in found.refused
    assert ":" in found.refused


@pytest.mark.parametrize(
    "points",
    [
        np.linspace(0, 1, 50)[:, None] * (1.0, 2.0),
        np.linspace(0, 1, 50)[:, None] * (1.0, 0.0),
        np.round(np.linspace(0, 1, 50))[:, None] * (0.3, 0.1),
        np.eye(2)[np.arange(50) % 2],
        1e-9 * arc(60.0)[0][:50],
    ],
    ids=["a line", "along x", "two places in turn", "two places by turns", "tiny"],
)
def test_degenerate_paths_give_no_warning_and_a_finite_estimate(points: Any) -> None:
    found = oriented_estimate(points, np.linspace(0.0, 1.0, len(points)), 0.01)
    assert np.isfinite(found.center).all()
    assert np.isfinite(found.covariance).all()
    assert found.refused is not None or np.isfinite(found.rms_error)


@given(
    st.lists(st.tuples(values, values, st.floats(-4.0, 4.0)), max_size=30),
)
@example(  # the noise variance exceeds the variance of the points along one axis
    [
        (0.0, 0.75, 1.0),
        (0.75, 0.0, 0.0),
        (-0.75, 0.0, 0.0),
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0),
        (0.0, 0.5, 0.0),
    ]
)
@settings(deadline=None, max_examples=60)
def test_oriented_and_geometric_estimates_of_any_input_are_finite_or_refused(rows: Any) -> None:
    data = np.reshape(rows, (-1, 3))
    aided = oriented_estimate(data[:, :2], data[:, 2], 0.01)
    for found in (aided, geometric_estimate(data[:, :2])):
        assert np.isfinite(found.center).all()
        assert np.isfinite(found.covariance).all()
        if found.refused is not None:
            assert ":" in found.refused or ";" in found.refused


@given(st.lists(st.tuples(values, values), min_size=4, max_size=30))
@example([(0.0, 0.75), (0.75, 0.0), (-0.75, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.5)])
@settings(deadline=None, max_examples=60)
def test_circle_estimates_of_any_points_have_no_negative_variance(rows: Any) -> None:
    points = np.reshape(rows, (-1, 2))
    for method in ("kasa", "pratt", "taubin", "hyper"):
        found = circle_estimate(points, method=method, limits=WIDE)
        assert found.bound >= 0.0
        assert (np.linalg.eigvalsh(found.covariance) >= -1e-12).all()
    many = fit_circles(points)
    assert bool(many.valid) == bool(np.isfinite(many.covariance).all())


def test_geometric_fit_equals_hyper_on_clean_points_and_resists_outliers() -> None:
    p, _ = arc(90.0)
    plain = circle_estimate(p)
    found = geometric_estimate(p, robust=False)
    assert found.center == pytest.approx(plain.center, abs=2e-4)
    assert found.rms_error == pytest.approx(plain.rms_error, rel=0.1)
    p[::10] += (0.04, 0.02)
    assert np.linalg.norm(geometric_estimate(p).center) < 0.006
    assert np.linalg.norm(circle_estimate(p).center) > 0.01


def test_markers_round_the_joint_share_their_center() -> None:
    each = [arc(20.0, seed=k, at=a)[0] for k, a in enumerate((0.0, 0.25, -0.3, 0.6))]
    together = geometric_estimate(np.stack(each, axis=1), robust=False)
    joined, C = combine([circle_estimate(p, limits=WIDE) for p in each])
    assert np.linalg.norm(together.center) < 0.01
    assert np.linalg.norm(joined) < 0.012
    assert np.sqrt(np.trace(C)) == pytest.approx(together.rms_error, rel=0.3)
