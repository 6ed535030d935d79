"""Circle fits: closed form, equality of streaming and batch fit, predicted and actual error."""

from __future__ import annotations

from math import exp, inf, isfinite, nan, pi, sqrt
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import eig
from scipy.stats import f, norm

from jointfit_daemon.center_of_rotation._path_statistics import arc_of_spread
from jointfit_daemon.center_of_rotation.planar import (
    GATE,
    CircleLimits,
    RunningCircle,
    circle_estimate,
    ellipse_scale,
    fit_circle,
    fit_circles,
    geometric_estimate,
)
from jointfit_daemon.center_of_rotation.planar._circle_estimate import arc_about
from jointfit_daemon.center_of_rotation.planar._circle_fit import persistence
from jointfit_daemon.center_of_rotation.planar._moments import moments_of, moments_of_one

anything = st.one_of(
    st.floats(-2.0, 2.0), st.just(nan), st.just(0.0), st.floats(allow_nan=True, allow_infinity=True)
)
METHODS = ("kasa", "pratt", "taubin", "hyper")


def swing(
    n: int = 400,
    arc: float = 60.0,
    noise: float = 0.002,
    seed: int = 0,
    center: tuple[float, float] = (0.2, -0.4),
) -> Any:
    rng = np.random.default_rng(seed)
    t = np.deg2rad(arc) / 2 * np.sin(np.arange(n) * 0.05)
    p = np.asarray(center) + 0.3 * np.stack((np.cos(t), np.sin(t)), axis=-1)
    return p + rng.normal(0.0, noise, p.shape)


def fed(points: Any, **options: Any) -> Any:
    running = RunningCircle(**options)
    for x, y in np.asarray(points, dtype=float).tolist():
        running.feed(x, y)
    return running


def by_eigenvalues(p: Any, method: Any) -> Any:
    middle = p.mean(axis=0)
    d = p - middle
    z = (d**2).sum(axis=1)
    v = np.column_stack((z, d, np.ones(len(p))))
    M = v.T @ v / len(p)
    taubin = np.diag([4 * z.mean(), 1, 1, 0.0])
    pratt = np.diag([0, 1, 1, 0.0])
    pratt[0, 3] = pratt[3, 0] = -2.0
    B = {"taubin": taubin, "pratt": pratt, "hyper": 2 * taubin - pratt}[method]
    values, vectors = eig(M, B)
    values = np.where(np.isfinite(values), values.real, inf)
    values[values <= 1e-12] = inf
    A, b, c, _ = vectors[:, np.argmin(values)].real
    return middle - np.array([b, c]) / (2 * A)


@pytest.mark.parametrize("method", METHODS[1:])
@pytest.mark.parametrize("arc", [30.0, 90.0, 340.0])
def test_closed_form_circles_equal_the_eigenproblem_solution(method: Any, arc: float) -> None:
    p = swing(arc=arc)
    expected = by_eigenvalues(p, method)
    assert np.abs(fit_circle(p, method=method)[:2] - expected).max() < 1e-9
    batch = fit_circles(p[None], method=method, tempered=False)
    assert np.abs(batch.center[0] - expected).max() < 1e-9


def test_kasa_is_the_linear_solution() -> None:
    p = swing()
    A = np.column_stack((2 * p, np.ones(len(p))))
    expected = np.linalg.lstsq(A, (p**2).sum(axis=1), rcond=None)[0][:2]
    assert np.abs(fit_circle(p, method="kasa")[:2] - expected).max() < 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_noise_free_points_give_the_exact_circle(method: Any) -> None:
    p = swing(noise=0.0)
    x, y, radius = fit_circle(p, method=method)
    assert (x, y, radius) == pytest.approx((0.2, -0.4, 0.3), abs=1e-9)


@given(st.floats(0.95, 1.0), st.integers(0, 9), st.sampled_from(METHODS), st.floats(-3.0, 3.0))
@settings(max_examples=25, deadline=None)
def test_running_circle_equals_batch_fit_with_forgetting_and_gaps(
    forgetting: float, seed: int, method: Any, far: float
) -> None:
    p = swing(n=300, seed=seed, center=(far, -far))
    p[np.random.default_rng(seed).random(300) < 0.1] = nan
    live = fed(p, forgetting=forgetting, method=method).estimate()
    batch = circle_estimate(p, forgetting ** np.arange(299, -1, -1.0), method=method)
    assert np.abs(live.center - batch.center).max() < 1e-9
    assert np.abs(live.covariance - batch.covariance).max() < 1e-9
    assert live.frames == batch.frames
    assert live.effective_frames == pytest.approx(batch.effective_frames, rel=1e-6)


@pytest.mark.parametrize("window", [50, 200])
def test_windowed_running_circle_equals_fit_of_last_frames(window: int) -> None:
    p = np.concatenate((swing(n=1500) + 4.0, swing(n=1500, seed=1)))
    p[2990] = nan
    live = fed(p, window=window).estimate()
    batch = circle_estimate(p[-window - 1 :])
    assert batch.frames == live.frames == window
    assert np.abs(live.center - batch.center).max() < 1e-9
    assert live.rms_error == pytest.approx(batch.rms_error, abs=1e-9)


def test_many_circles_at_once_are_the_same_circles() -> None:
    """Fits of many circles in one call equal the fits of the single circles."""
    sets = np.stack([swing(seed=k) for k in range(5)])
    found = fit_circles(sets, correlated=True)
    for k, p in enumerate(sets):
        one = circle_estimate(p)
        assert np.abs(found.center[k] - one.center).max() < 1e-9
        assert found.covariance[k] == pytest.approx(one.covariance, rel=1e-6)
        assert found.conditioning[k] == pytest.approx(one.conditioning, rel=1e-6)


def test_moments_of_one_equals_moments_of() -> None:
    p, w = swing(), np.random.default_rng(1).random(400)
    assert np.array(moments_of(p, w)) == pytest.approx(np.array(moments_of_one(p, w)), rel=1e-9)


def test_forgetting_follows_a_center_that_moves() -> None:
    p = np.concatenate((swing(n=600), swing(n=600, seed=1, center=(0.25, -0.4))))
    assert fed(p, forgetting=0.98).estimate().center == pytest.approx([0.25, -0.4], abs=0.01)


def test_robust_running_circle_reduces_weight_of_a_jump() -> None:
    p = swing(n=600)
    p[100::20] += (0.05, -0.08)
    robust, plain = fed(p, robust=True).estimate(), fed(p).estimate()
    truth = np.array([0.2, -0.4])
    assert np.linalg.norm(robust.center - truth) < 0.006
    assert np.linalg.norm(plain.center - truth) > 3 * np.linalg.norm(robust.center - truth)
    assert plain.rms_error > 3 * robust.rms_error


@given(st.lists(st.tuples(anything, anything), max_size=40), st.sampled_from(METHODS))
@example([(0.0, 0.5620884694558803), *(8 * [(0.0, 0.0)])], "kasa")  # rounded variance: -6e-17
@settings(deadline=None)
def test_circle_estimate_of_any_points_is_finite_or_refused(points: Any, method: Any) -> None:
    with np.errstate(all="ignore"):
        for found in (
            fed(np.reshape(points, (-1, 2)), method=method).estimate(),
            fed(np.reshape(points, (-1, 2)), method=method, window=8, robust=True).estimate(),
        ):
            assert np.isfinite(found.center).all()
            assert np.isfinite(found.covariance).all()
            assert found.refused is not None or isfinite(found.rms_error)
            if found.refused is not None:
                assert ":" in found.refused


@pytest.mark.parametrize(
    ("points", "cause"),
    [
        (np.full((50, 2), nan), "missing in every frame"),
        (np.ones((50, 2)), "no motion"),
        (np.linspace(0, 1, 50)[:, None] * (1.0, 2.0), "line"),
        (swing(n=3), "3 usable frames"),
        (swing(arc=3.0, noise=0.0), "turned 4°"),
        (swing(arc=14.0), "arc"),
        (40.0 * swing(noise=0.0), "marker names"),
    ],
)
def test_a_refusal_names_cause_and_remedy(points: Any, cause: Any) -> None:
    for found in (circle_estimate(points), fed(points).estimate()):
        assert found.refused is not None
        assert cause in found.refused
        assert ":" in found.refused


def test_refused_circle_has_infinite_error() -> None:
    found = fed(np.ones((50, 2))).estimate()
    assert found.rms_error == found.bound == inf
    assert fed(np.ones((50, 2))).circle() is None
    with pytest.raises(ValueError, match="line"):
        fit_circle(np.ones((5, 2)))


def test_coordinates_beyond_ten_kilometers_are_missing() -> None:
    p = swing()
    p[7], p[9] = (1e300, 0.0), (0.0, -inf)
    live, batch = fed(p, robust=True).estimate(), circle_estimate(p)
    assert live.frames == batch.frames == 398
    assert live.refused is batch.refused is None


def test_running_circle_rejects_contradictory_settings() -> None:
    for wrong in ({"forgetting": 0.0}, {"window": 3}, {"window": 9, "forgetting": 0.9}):
        with pytest.raises(ValueError, match=r"needed|needs"):
            RunningCircle(**wrong)


def test_running_circle_is_refused_after_all_weight_is_forgotten() -> None:
    running = fed(np.concatenate((swing(), np.full((2000, 2), nan))), forgetting=0.5)
    found = running.estimate()
    assert found.refused is not None
    assert "at least 4" in found.refused


def test_running_circle_bears_weights_that_cancel_by_rounding() -> None:
    running = RunningCircle(window=4)
    for (x, y), weight in zip(swing().tolist(), [1e9] + 399 * [1.0], strict=True):
        running.feed(x, y, weight)
        assert isfinite(running.estimate().effective_frames)


def test_correlated_circles_of_unseen_points_are_not_valid() -> None:
    """The fit with `correlated=True` is not valid if all points are missing."""
    found = fit_circles(np.full((2, 9, 2), nan), correlated=True)
    assert not found.valid.any()


def test_running_circle_memory_is_bounded_in_a_gap() -> None:
    running = fed(swing(n=30), window=20)
    for _ in range(500):
        running.feed(nan, 0.0)
    assert len(running._kept) <= 21


def test_correlated_residuals_increase_the_covariance() -> None:
    rng = np.random.default_rng(0)
    wander = np.zeros((400, 2))
    for k in range(1, 400):
        wander[k] = 0.9 * wander[k - 1] + rng.normal(0, 0.001, 2)
    p = swing(noise=0.0) + wander
    shuffled = rng.permutation(p)
    for estimate in (circle_estimate, geometric_estimate):
        found, plain = estimate(p), estimate(shuffled)
        assert found.effective_frames < 100
        assert found.rms_error > 2.0 * plain.rms_error
    assert persistence(np.array([nan, -1.0, 0.5])) == pytest.approx([1.0, 1.0, 3.0])


@given(st.floats(0.01, 6.2))
def test_arc_of_spread_recovers_the_arc(arc: float) -> None:
    spread = 1.0 - (np.sin(arc / 2) / (arc / 2)) ** 2
    assert arc_of_spread(spread) == pytest.approx(arc, abs=1e-4)


def test_arcs_are_counted_between_the_outermost_points() -> None:
    t = np.linspace(3.0, 4.0, 40)  # the angles cross the discontinuity of atan2 at π
    p = np.stack((np.cos(t), np.sin(t)), axis=-1)
    assert arc_about(p, np.zeros(2)) == pytest.approx(1.0)
    t = np.linspace(0, 2 * pi, 40)
    assert arc_about(np.stack((np.cos(t), np.sin(t)), -1), np.zeros(2)) == pytest.approx(2 * pi)
    assert arc_about(p[:1], np.zeros(2)) == 0.0


# --- the 95 % ellipse --------------------------------------------------------------------------


def covered(truth: float) -> tuple[float, float]:
    """Return the coverage of published ellipses, and the fraction of centers that are published.

    Both are integrals over the estimated conditioning T (`CenterEstimate.conditioning`), which has
    the normal distribution N(truth, 1) if the number of frames is unlimited.
    """
    z, dz = np.linspace(-9, 9, 20_001, retstep=True)
    t = truth + z
    z, t = z[t >= GATE], t[t >= GATE]
    drawn = truth * t / (t**2 + 1.0)  # center divided by true radius, after shrinkage
    pull2 = ((drawn - 1.0) * t / drawn) ** 2
    allowed = np.array([ellipse_scale(1e9, float(v)) for v in t])
    room = np.sqrt(np.maximum(allowed - pull2, 0.0)) * drawn
    share = np.where(allowed > pull2, 2.0 * norm.cdf(room) - 1.0, 0.0)
    density = norm.pdf(z) * dz
    return float((share * density).sum() / density.sum()), float(density.sum())


@pytest.mark.parametrize("truth", [4.2, 4.6, 5.0, 5.5, 6.0, 6.5, 7.0, 8.0, 9.0, 12.0, 20.0, 60.0])
def test_published_ellipses_cover_95_percent_whatever_the_true_conditioning(truth: float) -> None:
    share, published = covered(truth)
    assert published > 0.03
    assert share == pytest.approx(0.95, abs=0.002)


@pytest.mark.parametrize("n", [5, 8, 20, 100])
def test_ellipse_of_few_frames_has_the_quantile_of_fisher(n: int) -> None:
    assert ellipse_scale(n, 1e9) == pytest.approx(2.0 * f.ppf(0.95, 2, n - 3), rel=1e-9)
    assert ellipse_scale(n, 5.9) == inf
    assert ellipse_scale(3.0, 10.0) == inf
    assert isfinite(ellipse_scale(3.01, 10.0)) or exp(600) > 0


def test_predicted_error_equals_actual_error_at_20_degrees() -> None:
    rng = np.random.default_rng(3)
    t = np.linspace(-0.5, 0.5, 100) * np.deg2rad(22.0)
    p = 0.3 * np.stack((np.cos(t), np.sin(t)), -1) + rng.normal(0, 0.002, (4000, 100, 2))
    found = fit_circles(p)
    actual = sqrt(np.nanmean((found.center**2).sum(axis=1)))
    claimed = sqrt(np.nanmean(np.trace(found.covariance, axis1=1, axis2=2)))
    assert 0.85 < claimed / actual < 1.15
    assert found.noise.mean() == pytest.approx(0.002, rel=0.01)


def test_circle_limits_of_the_caller_apply() -> None:
    p = swing(arc=24.0)
    strict, lax = CircleLimits(rms_error=0.001), CircleLimits(rms_error=1.0)
    refused = circle_estimate(p, limits=strict).refused
    assert refused is not None
    assert "predicted error" in refused
    assert circle_estimate(p, limits=lax).refused is None
