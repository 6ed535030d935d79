"""Three-frame centers with predicted errors; planes, grid search and Cramér-Rao bounds."""

from __future__ import annotations

from math import inf
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from bench.baselines.circle_theory import (
    arbitrary_error,
    circle_bound,
    circle_rms_bound,
    triangle_error,
)
from jointfit_daemon.center_of_rotation.planar import (
    Grid,
    equal_step_error,
    grid_center,
    plane_of,
    three_frame_center,
    three_frame_error,
    three_frame_estimate,
    three_frame_mean_squares,
)
from jointfit_daemon.center_of_rotation.planar._grid_search import grid_cost
from jointfit_daemon.center_of_rotation.study._circle_study import uniform_arc_rms

numbers = st.floats(-10.0, 10.0)
anything = st.floats(allow_nan=True, allow_infinity=True)


def on_circle(angles: Any, radius: Any = 0.3, center: tuple[float, float] = (0.0, 0.0)) -> Any:
    t = np.asarray(angles)
    return np.asarray(center) + radius * np.stack((np.cos(t), np.sin(t)), axis=-1)


@given(numbers, numbers, st.floats(0.02, 1.0), st.floats(0.0, 6.0), st.floats(0.3, 2.0))
def test_three_points_of_a_circle_give_its_center(
    x: Any, y: Any, radius: Any, first: Any, step: Any
) -> None:
    points = on_circle([first, first + step, first + 2 * step], radius, (x, y))
    assert np.abs(three_frame_center(points) - (x, y)).max() < 1e-11


@given(st.lists(anything, min_size=6, max_size=6))
@example([0.0, 0.0, 7e-155, 0.0, 0.0, 7e-155])  # the squares underflow
@example([0.0, 0.0, 2e-162, 1e-162, 1e-162, 2e-162])
@example([0.0, 0.0, 5e-324, 0.0, 0.0, 5e-324])
@example([0.0, 0.0, 1e200, 0.0, 0.0, 1e200])  # the squares overflow
@example([1e308, 0.0, -1e308, 0.0, 0.0, 1.0])
@example([1.0, 1.0, 1.0, 1.0 + 2**-52, 1.0 + 2**-52, 1.0])  # the center rounds to a point
@example([0.0, 0.0, 1.0, 0.0, 2.0, 5e-9])  # the points are nearly on a line
def test_three_frame_estimate_of_any_points_is_finite_or_refused(values: Any) -> None:
    with np.errstate(all="ignore"):
        found = three_frame_estimate(np.reshape(values, (3, 2)), 0.001)
    assert np.isfinite(found.center).all()
    assert np.isfinite(found.covariance).all()
    assert not np.isnan([found.rms_error, found.arc, found.bound, found.conditioning]).any()
    assert np.isfinite(found.radii).all()
    if found.refused is not None:
        assert ":" in found.refused  # the text has the form "cause: remedy"


def test_the_covariance_is_the_bound_of_three_points() -> None:
    t = np.array([0.2, 0.9, 1.7])
    found = three_frame_estimate(on_circle(t, center=(3.0, -2.0)), 0.001)
    assert found.covariance == pytest.approx(circle_bound(t, 0.001)[:2, :2], rel=1e-9)
    assert found.rms_error == pytest.approx(found.bound)


@pytest.mark.parametrize("points", [[[0, 0], [1, 1], [2, 2]], [[0, 0], [0, 0], [1, 0]]])
def test_points_on_a_line_are_infinitely_far_and_refused(points: Any) -> None:
    assert (three_frame_center(points) == inf).all()
    found = three_frame_estimate(points, 0.001)
    assert found.refused is not None
    assert "line" in found.refused
    assert found.rms_error == inf


def test_three_frame_estimate_refuses_an_arc_hidden_by_noise() -> None:
    found = three_frame_estimate(on_circle(np.deg2rad([0, 5, 10])), 0.001)
    assert found.refused is not None
    assert "noise" in found.refused
    assert three_frame_estimate(on_circle(np.deg2rad([0, 60, 120])), 0.001).refused is None


def test_both_forms_of_the_predicted_error_equal_the_bound() -> None:
    t = np.array([0.2, 0.9, 1.7])
    expected = circle_rms_bound(t, 0.001)
    assert arbitrary_error(t, 0.001) == pytest.approx(expected, rel=1e-12)
    assert triangle_error(on_circle(t), 0.001) == pytest.approx(expected, rel=1e-12)
    assert (arbitrary_error(t, 1.0)) ** 2 == pytest.approx(22.1, abs=0.05)


@pytest.mark.parametrize(
    ("step", "factor"), [(5, 322), (10, 80.7), (30, 9.25), (60, 2.58), (90, 1.414), (120, 1.155)]
)
def test_equal_steps_have_the_known_errors(step: Any, factor: Any) -> None:
    found = float(equal_step_error(np.deg2rad(step), 1.0))
    assert found == pytest.approx(factor, rel=2e-3)
    angles = np.deg2rad(step) * np.arange(3)
    assert found == pytest.approx(float(arbitrary_error(angles, 1.0)), rel=1e-12)


def test_three_frames_without_rotation_or_with_half_turns_are_rejected() -> None:
    assert equal_step_error(0.0, 0.001) == inf
    assert equal_step_error(np.pi, 0.001) == inf
    assert arbitrary_error([0.0, 0.0, 1.0], 0.001) == inf
    assert triangle_error([[0, 0], [1, 1], [2, 2]], 0.001) == inf


def test_a_plane_needs_an_axis() -> None:
    with pytest.raises(ValueError, match="axis"):
        plane_of((0, 0, 0))


@given(st.tuples(numbers, numbers, numbers).filter(lambda a: np.linalg.norm(a) > 0.1))
def test_a_plane_is_across_its_axis_and_right_handed(axis: Any) -> None:
    first, second = plane_of(axis).T
    n = np.array(axis) / np.linalg.norm(axis)
    assert np.cross(first, second) == pytest.approx(n, abs=1e-12)
    assert np.abs(np.array(axis) @ plane_of(axis)).max() < 1e-12
    assert plane_of((1, 0, 0)) == pytest.approx(np.eye(3)[:, 1:])


def test_a_grid_search_finds_the_node_at_the_center() -> None:
    grid = Grid((0.0, 0.0), 0.05, 0.01)
    points = on_circle(np.linspace(0, 4, 30), 0.2, (0.02, -0.03))
    assert grid_center(points, grid) == pytest.approx([0.02, -0.03])
    many = np.stack([points, points + np.array([0.01, 0.0])])
    assert grid_center(many, grid) == pytest.approx(np.array([[0.02, -0.03], [0.03, -0.03]]))
    assert grid_cost(points, grid.nodes()).min() == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("arc", "free", "known"), [(10, 86.4, 1.97), (45, 4.34, 0.455), (90, 1.14, 0.258)]
)
def test_bounds_of_even_arcs_are_the_known_ones(arc: float, free: Any, known: Any) -> None:
    phi, n = np.deg2rad(arc), 20_000
    middles = (np.arange(n) + 0.5) / n * phi
    scale = np.sqrt(n / 100)
    for radius_known, expected in ((False, free), (True, known)):
        ends = np.linspace(0.0, phi, 100)
        table = circle_rms_bound(ends, 1.0, known_radius=radius_known)
        assert table == pytest.approx(expected, rel=5e-3)
        closed = uniform_arc_rms(phi, 100, 1.0, known_radius=radius_known)
        exact = scale * circle_rms_bound(middles, 1.0, known_radius=radius_known)
        assert exact == pytest.approx(closed, rel=1e-4)
    assert uniform_arc_rms(1e-3, 100, 1.0) == pytest.approx(26.8 / 10 / 1e-6, rel=2e-3)


@pytest.mark.parametrize("angles", [[], [0.3], [0.3, 0.3, 0.3], [0.0, np.pi]])
def test_bound_is_infinite_without_information(angles: Any) -> None:
    assert circle_rms_bound(angles, 0.001) == inf
    assert np.isinf(np.diag(circle_bound(angles, 0.001))).all()
    assert uniform_arc_rms(0.0, 10, 0.001) == inf
    assert uniform_arc_rms(1e-100, 10, 0.001) == inf
    assert uniform_arc_rms(1e-9, 10, 0.001, known_radius=True) == inf


@given(
    st.lists(st.floats(0.0, 6.2), min_size=3, max_size=3),
    st.floats(0.05, 1.0),
    st.integers(0, 10_000),
)
def test_the_exact_error_is_that_of_the_closed_form(
    angles: list[float], radius: float, seed: int
) -> None:
    t = np.array(angles)
    assume(np.abs(np.sin((t - np.roll(t, 1)) / 2)).min() > 0.1)
    errors = np.random.default_rng(seed).normal(0.0, 0.002, (50, 3, 2))
    measured = on_circle(t, radius) + errors
    found = three_frame_error(t, radius, errors)
    np.testing.assert_allclose(found, three_frame_center(measured), rtol=1e-6, atol=1e-9)


SIX = np.array([[0.3, 1.2], [0.8, 0.4], [1.5, 0.6]]) * 1e-3


@pytest.mark.parametrize(
    "noise",
    [SIX, SIX[:, :1], SIX[1], 0.0007],
    ids=["six", "one a frame", "one an axis", "one"],
)
def test_predicted_mean_squares_are_those_of_simulated_noise(noise: Any) -> None:
    t = np.array([0.3, 1.4, 2.9])
    drawn = np.random.default_rng(3).normal(size=(400_000, 3, 2)) * noise
    found = three_frame_center(on_circle(t, 0.4) + drawn)
    expected = three_frame_mean_squares(t, noise)
    np.testing.assert_allclose((found**2).mean(axis=0), expected, rtol=0.01)
    estimate = three_frame_estimate(on_circle(t, 0.4), noise)
    np.testing.assert_allclose(np.diag(estimate.covariance), expected, rtol=1e-9)
    products = float((found[:, 0] * found[:, 1]).mean())
    assert products == pytest.approx(estimate.covariance[0, 1], abs=0.01 * expected.max())


def test_both_mean_squares_add_up_to_equation_14() -> None:
    """The mean squares of both axes add up to the corrected equation 14 of Akbarifar et al."""
    t = np.array([[0.2, 0.9, 1.7], [0.1, 2.0, 4.5]])
    total = three_frame_mean_squares(t, 0.001).sum(axis=-1)
    np.testing.assert_allclose(total, arbitrary_error(t, 0.001) ** 2, rtol=1e-12)
    assert np.isinf(three_frame_mean_squares([0.5, 0.5, 1.0], 0.001)).all()
