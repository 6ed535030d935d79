"""Streaming sphere fit: equality with the batch fit, predicted error, and outliers."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.subjects.simulated_joints import CHILD, ball_turns, carried, fan, hinge_turns
from jointfit_daemon.center_of_rotation.planar import fit_circles
from jointfit_daemon.center_of_rotation.spatial import RunningSphere, SphereLimits, fit_running

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

CENTER = np.array([0.1, -0.2, 0.9])


def ball(rng: np.random.Generator, rom: float = 45.0, n: int = 300, noise: float = 1e-3) -> Array:
    paths = carried(ball_turns(rng, rom, n))
    return np.asarray(CENTER + paths + rng.normal(0, noise, paths.shape))


def hinge(rng: np.random.Generator, rom: float = 60.0, noise: float = 1e-3) -> Array:
    paths = carried(hinge_turns(rom, axis=0))
    return np.asarray(CENTER + paths + rng.normal(0, noise, paths.shape))


def fed(points: Array, **options: float) -> RunningSphere:
    stream = RunningSphere(points.shape[1], dimension=points.shape[2], robust=False, **options)  # type: ignore[arg-type]  # only forgetting is passed
    for frame in points:
        stream.feed(frame)
    return stream


@pytest.mark.parametrize("forgetting", [1.0, 0.99])
@pytest.mark.parametrize("gaps", [0.0, 0.3])
def test_streaming_equals_all_frames_at_once(forgetting: float, gaps: float) -> None:
    rng = np.random.default_rng(1)
    points = ball(rng)
    points[rng.uniform(size=points.shape[:2]) < gaps] = np.nan
    weights = np.tile(forgetting ** np.arange(len(points) - 1, -1, -1)[:, None], (1, 4))
    live = fed(points, forgetting=forgetting).estimate()
    whole = fit_running(points, weights)
    assert np.abs(live.center - whole.center).max() < 1e-9
    assert np.abs(live.covariance - whole.covariance).max() < 1e-12
    assert live.noise == pytest.approx(whole.noise, abs=1e-9)
    assert live.rms_error == pytest.approx(whole.rms_error, abs=1e-9)


@given(st.integers(0, 10_000), st.tuples(*[st.floats(-0.6, 0.6)] * 3))
@settings(max_examples=15, deadline=None)
def test_position_of_the_first_sample_does_not_affect_the_sphere(
    seed: int, away: tuple[float, ...]
) -> None:
    points = ball(np.random.default_rng(seed), n=120)
    stream = RunningSphere(4, robust=False)
    stream.feed(points[0] + away, np.zeros(4))
    for frame in points[1:]:
        stream.feed(frame)
    live, whole = stream.estimate(), fit_running(points[1:])
    assert np.abs(live.center - whole.center).max() < 1e-8


def test_one_marker_in_a_plane_is_the_hyper_circle() -> None:
    rng = np.random.default_rng(2)
    points = fan(60.0)[:, :1] + rng.normal(0, 1e-3, (100, 1, 2))
    assert np.allclose(fit_running(points).center, fit_circles(points[:, 0]).center, atol=2e-5)


def test_a_hinge_shows_its_axis_and_infinite_variance_along_it() -> None:
    found = fit_running(hinge(np.random.default_rng(3)), near=CENTER)
    assert found.refused is None
    assert found.axis is not None
    assert abs(found.axis[0]) > 0.9999
    assert found.rms_error == inf == found.bound
    assert "hinge" in found.flags
    assert np.linalg.norm(found.center - CENTER) < 2e-3
    assert np.allclose(found.covariance @ found.axis, 0.0, atol=1e-12)


def test_predicted_error_falls_and_exceeds_the_bound() -> None:
    points = ball(np.random.default_rng(4), n=1600)
    stream, told = RunningSphere(4), []
    for number, frame in enumerate(points, 1):
        stream.feed(frame)
        if number in {100, 400, 1600}:
            found = stream.estimate()
            told.append(found.rms_error)
            assert found.bound == pytest.approx(found.rms_error, rel=0.3)
            assert found.frames == number
    assert told[0] / told[1] == pytest.approx(2.0, rel=0.3)
    assert told[1] / told[2] == pytest.approx(2.0, rel=0.3)


def test_a_marker_that_jumps_and_one_that_slips_move_the_center_little() -> None:
    rng = np.random.default_rng(5)
    points = ball(rng, 60.0, n=1000)
    points[400:460, 0] += 0.08
    points[600:, 1] += 0.05
    stream = RunningSphere(4)
    for number, frame in enumerate(points):
        stream.feed(frame)
        if number % 20 == 0:
            stream.estimate()
    found = stream.estimate()
    assert np.linalg.norm(found.center - CENTER) < 1.5e-3
    assert any(flag.endswith(":1") for flag in found.flags)


def test_a_ghost_marker_in_the_first_sample_has_no_lasting_effect() -> None:
    points = ball(np.random.default_rng(6), n=400)
    points[0] += 50.0
    stream = RunningSphere(4)
    for frame in points:
        stream.feed(frame)
    found = stream.estimate()
    assert found.refused is None
    assert np.linalg.norm(found.center - CENTER) < 3e-3
    assert "marker_moved:0" in found.flags


def test_noise_of_one_marker_costs_only_that_marker() -> None:
    rng = np.random.default_rng(7)
    errors = []
    for _ in range(30):
        points = ball(rng)
        points[:, 2] += rng.normal(0, 0.02, (len(points), 3))
        found = fit_running(points)
        errors.append(np.linalg.norm(found.center - CENTER))
        assert "noisy_marker:2" in found.flags
    assert np.sqrt(np.mean(np.square(errors))) < 1.3e-3


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.full((100, 2, 3), np.nan), "keep the markers visible"),
        (np.ones((100, 2, 3)), "move the joint"),
        (np.linspace(0, 0.2, 100)[:, None, None] * np.ones((1, 2, 3)), "no curvature"),
        (ball(np.random.default_rng(8), rom=2.0), "range of motion|further|no curvature"),
        (ball(np.random.default_rng(8), n=9), "usable frames"),
    ],
    ids=["occluded", "still", "collinear", "too little", "too few"],
)
def test_running_sphere_refusal_names_cause_and_remedy(points: Array, words: str) -> None:
    found = fed(points).estimate()
    assert found.refused is not None
    assert any(word in found.refused for word in words.split("|"))
    assert found.rms_error == inf or found.rms_error > 0.005


def some_points(kind: str, rng: np.random.Generator, noise: float) -> Array:
    if kind == "ball":
        return ball(rng, n=60, noise=noise)
    if kind == "hinge":
        return hinge(rng, noise=noise)[:60]
    if kind == "line":
        return np.asarray(rng.uniform(size=(60, 1, 1)) * np.ones((1, 3, 3)))
    if kind == "two points":
        return np.asarray(rng.integers(0, 2, (60, 1, 1)) * np.ones((1, 3, 3)))
    return np.ones((60, 2, 3))


@given(
    st.integers(0, 1000),
    st.sampled_from(["ball", "hinge", "line", "point", "two points"]),
    st.sampled_from([0.0, 1e-9, 1e-3, 0.1]),
    st.floats(0.0, 1.0),
)
@settings(max_examples=60, deadline=None)
def test_nan_center_is_always_rejected(seed: int, kind: str, noise: float, hidden: float) -> None:
    rng = np.random.default_rng(seed)
    points = some_points(kind, rng, noise)
    points = points + rng.normal(0, noise, points.shape) if noise else points.astype(np.float64)
    points[rng.uniform(size=points.shape[:2]) < hidden] = np.nan
    stream = RunningSphere(points.shape[1])
    for number, frame in enumerate(points):
        stream.feed(frame)
        if number % 7:
            continue
        found = stream.estimate()
        if found.refused is None:
            assert np.isfinite(found.center).all()
            assert np.isfinite(found.covariance).all()
            assert np.linalg.eigvalsh(found.covariance)[0] > -1e-12 * np.trace(found.covariance)
            assert not np.isnan([found.rms_error, found.noise, found.bound, found.arc]).any()


def test_soft_tissue_artefact_does_not_make_a_hinge_a_ball_joint() -> None:
    rng = np.random.default_rng(9)
    points = hinge(rng, 70.0, noise=2e-3)
    s = np.linspace(0, 4 * np.pi, len(points))
    points[:, :, 0] += 0.004 * np.sin(s)[:, None] * np.array([1.0, -0.5, 0.7, 0.2])
    found = fit_running(points, limits=SphereLimits(min_direction=np.radians(3.0)))
    assert found.axis is not None
    assert abs(found.axis[0]) > 0.99


@pytest.mark.parametrize(("markers", "forgetting"), [(0, 1.0), (2, 0.0), (2, 1.1)])
def test_running_sphere_rejects_invalid_arguments(markers: int, forgetting: float) -> None:
    with pytest.raises(ValueError, match="at least one"):
        RunningSphere(markers, forgetting=forgetting)


def test_hidden_marker_has_no_radius_and_does_not_change_the_center() -> None:
    points = ball(np.random.default_rng(11))
    points[:, 3] = np.nan
    found = fit_running(points)
    assert found.refused is None
    assert np.isnan(found.radii).tolist() == [False, False, False, True]
    assert np.allclose(found.radii[:3], np.linalg.norm(CHILD[:3], axis=1), atol=3e-3)
