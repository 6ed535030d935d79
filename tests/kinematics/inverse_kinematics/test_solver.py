"""Poses from markers by the solver for whole trials, which solves all instants at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from bench.subjects.adult_lower_limbs import measured, oc4_lower
from jointfit_daemon.kinematics.chains import (
    ChainModel,
    Joint,
    Marker,
    Segment,
    apply_step,
    jacobian,
    marker_positions,
    rest_state,
    step_between,
)
from jointfit_daemon.kinematics.inverse_kinematics import (
    IkOptions,
    marker_fit,
    marker_slots,
    solve_frames,
    tracking_error,
)
from jointfit_daemon.kinematics.inverse_kinematics._normal_equations import normal_equations
from tests.kinematics.chain_coordinates import hinge_angles

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.kinematics.chains import ChainState

COUNT = 40


def leg(seed: int = 0, per_segment: int = 4) -> ChainModel:
    """Return pelvis, thigh (ball), shank (hinge) and foot (ball), with markers on all sides."""
    rng = np.random.default_rng(seed)
    segments = (
        Segment("pelvis"),
        Segment("thigh", "pelvis", Joint("ball", (0.1, 0.0, -0.1), (0.0, 0.01, 0.0))),
        Segment("shank", "thigh", Joint("hinge", (0.0, 0.0, -0.4), limits=(-2.4, 0.1))),
        Segment("foot", "shank", Joint("ball", (0.0, 0.0, -0.4))),
    )
    spots = {"pelvis": (0.0, 0.0, 0.0), "foot": (0.0, 0.08, -0.04)}
    return ChainModel(
        segments,
        tuple(
            Marker(
                f"{s.name}{k}",
                s.name,
                tuple(
                    (np.array(spots.get(s.name, (0, 0, -0.2))) + rng.normal(0, 0.07, 3)).tolist()
                ),
            )
            for s in segments
            for k in range(per_segment)
        ),
    )


def walk(model: ChainModel, count: int = COUNT, heading: float = 2.5) -> ChainState:
    """Return a smooth movement in which the whole body is rotated by `heading`, rad."""
    phase = np.linspace(0.0, 2.0 * np.pi, count)
    step = np.zeros((count, model.nq))
    step[:, 2] = heading
    step[:, 3] = 0.3 * phase
    step[:, 5] = 0.9
    step[:, 6] = 0.5 * np.sin(phase)
    step[:, 9] = -0.7 + 0.6 * np.cos(phase)
    step[:, 10] = 0.3 * np.cos(phase)
    return apply_step(model, rest_state(model, count), step)


def turns_off(model: ChainModel, a: ChainState, b: ChainState) -> np.ndarray:
    return np.delete(step_between(model, a, b), [3, 4, 5], axis=1)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_sums_over_segments_are_the_dense_normal_equations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = leg(seed, int(rng.integers(1, 5)))
    state = walk(model, 3)
    y = marker_positions(model, state) + rng.normal(0.0, 0.1, (3, len(model.markers), 3))
    w = rng.uniform(0.0, 2.0, y.shape[:2])
    slots = marker_slots(model)
    found = marker_fit(slots, state, slots.vectors_to_slots(y), slots.to_slots(w))
    H, g = normal_equations(slots, found)
    J, e = jacobian(model, state), marker_positions(model, state) - y
    np.testing.assert_allclose(H, np.einsum("tmik,tm,tmil->tkl", J, w, J), atol=1e-10)
    np.testing.assert_allclose(g, np.einsum("tmik,tm,tmi->tk", J, w, e), atol=1e-10)
    np.testing.assert_allclose(found.cost, np.einsum("tm,tmi,tmi->t", w, e, e), atol=1e-12)


@pytest.mark.parametrize("heading", [0.0, 1.5, 3.1, -2.0])
def test_true_markers_determine_the_pose_without_a_start(heading: float) -> None:
    model = leg()
    truth = walk(model, heading=heading)
    found = solve_frames(model, marker_positions(model, truth))
    assert found.converged.all()
    assert not found.underdetermined.any()
    assert np.abs(turns_off(model, truth, found.state)).max() < 1e-9
    assert tracking_error(found.residuals) < 1e-10


def test_an_instant_without_a_better_step_has_not_converged() -> None:
    # The markers require a knee rotation beyond 180 degrees, where the excess over the limit of
    # the knee jumps to a larger value.
    model, count = leg(), 20
    step, begin = np.zeros((2, count, model.nq))
    step[:, 9], begin[:, 9] = -4.0, np.linspace(-3.1, -2.4, count)
    rest = rest_state(model, count)
    markers = marker_positions(model, apply_step(model, rest, step))
    start = apply_step(model, rest, begin)
    found = solve_frames(model, markers, start=start, options=IkOptions(limit_m2=0.1))
    assert (found.iterations < IkOptions().iterations).any()  # the damping ended the search
    assert not found.converged.any()


def test_the_least_squares_are_those_of_an_independent_solver() -> None:
    model = leg()
    truth = walk(model, 4)
    y = marker_positions(model, truth) + np.random.default_rng(1).normal(0, 0.01, (4, 16, 3))
    w = np.random.default_rng(2).uniform(0.2, 2.0, 16)
    found = solve_frames(model, y, w, options=IkOptions(tolerance=1e-13))
    for t in range(4):
        one = truth.take(slice(t, t + 1))

        def error(step: np.ndarray, one: ChainState = one, t: int = t) -> np.ndarray:
            x = marker_positions(model, apply_step(model, one, step[None]))[0]
            return np.asarray((np.sqrt(w)[:, None] * (x - y[t])).ravel())

        best = least_squares(error, np.zeros(model.nq), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        cost = float(np.sum(w[:, None] * found.residuals[t] ** 2))
        assert cost == pytest.approx(2 * best.cost, rel=1e-9)


def test_one_missing_marker_per_segment_does_not_change_the_noise_free_pose() -> None:
    model = leg()
    truth = walk(model)
    y = marker_positions(model, truth)
    y[::2, [0, 5, 10, 15]] = np.nan
    found = solve_frames(model, y)
    assert np.abs(turns_off(model, truth, found.state)).max() < 1e-9
    assert np.isnan(found.residuals[::2, 0]).all()
    assert (found.weights[::2, 0] == 0.0).all()


def test_underdetermined_instants_follow_the_one_before() -> None:
    model = leg()
    truth = walk(model)
    y = marker_positions(model, truth)
    y[10:14, 13:16] = np.nan  # the foot has one marker, and may rotate about a line
    y[0, 13:16] = np.nan
    found = solve_frames(model, y)
    assert np.flatnonzero(found.underdetermined).tolist() == [0, 10, 11, 12, 13]
    off = np.abs(turns_off(model, truth, found.state))
    assert off[[10, 11, 12, 13]].max() < np.radians(12)
    assert off[0].max() < np.radians(5)
    assert np.delete(off, [0, 10, 11, 12, 13], axis=0).max() < 1e-9


def test_an_instant_without_any_marker_stays_where_the_last_one_was() -> None:
    model = leg()
    y = marker_positions(model, walk(model))
    y[7] = np.nan
    found = solve_frames(model, y)
    assert found.underdetermined[7]
    np.testing.assert_allclose(found.origins[7], found.origins[6], atol=1e-9)
    assert np.isfinite(found.rotations).all()


def test_a_trial_without_markers_is_underdetermined() -> None:
    model = leg()
    found = solve_frames(model, np.full((3, 16, 3), np.nan))
    assert found.underdetermined.all()
    assert np.isfinite(found.rotations).all()
    assert np.isnan(tracking_error(found.residuals))


def test_robust_weights_exclude_a_stray_marker() -> None:
    model = leg()
    truth = walk(model)
    rng = np.random.default_rng(5)
    y = marker_positions(model, truth) + rng.normal(0, 0.001, (COUNT, 16, 3))
    y[:, 6] += (0.15, -0.1, 0.1)
    plain = solve_frames(model, y)
    robust = solve_frames(model, y, options=IkOptions(huber_m=0.005, reweightings=6))

    def rms(state: ChainState) -> float:
        return float(np.sqrt(np.mean(turns_off(model, truth, state) ** 2)))

    assert rms(robust.state) < 0.25 * rms(plain.state)
    assert robust.weights[:, 6].max() < 0.1


def test_limits_restrict_a_hinge_only_if_they_have_a_weight() -> None:
    model = leg()
    beyond = np.zeros((1, model.nq))
    beyond[0, 9] = 0.6
    y = marker_positions(model, apply_step(model, rest_state(model), beyond))
    free = hinge_angles(model, solve_frames(model, y).state)["shank"]
    held = solve_frames(model, y, options=IkOptions(limit_m2=100.0))
    assert free == pytest.approx([0.6])
    assert hinge_angles(model, held.state)["shank"] == pytest.approx([0.1], abs=0.01)


def test_a_start_is_used() -> None:
    model = leg()
    truth = walk(model)
    found = solve_frames(model, marker_positions(model, truth), start=truth)
    assert found.iterations.max() == 1


@pytest.mark.parametrize(
    ("shape", "weights", "said"),
    [
        ((3, 15, 3), None, "expected \\(instants, 16, 3\\)"),
        ((16, 3), None, "expected"),
        ((3, 16, 3), np.ones(15), "weights have shape"),
        ((3, 16, 3), -np.ones(16), "not negative"),
    ],
)
def test_shapes_that_do_not_belong_together_are_named(
    shape: tuple[int, ...], weights: np.ndarray | None, said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        solve_frames(leg(), np.zeros(shape), weights)


@pytest.mark.parametrize(
    ("trial", "every", "expected_mm"),
    [("static1", 8, 2.37), ("walking1", 1, 6.57), ("squats1", 8, 10.59), ("DJ1", 2, 8.62)],
)
def test_a_recorded_adult_fits_as_the_reference_does(
    shared_data: Path, trial: str, every: int, expected_mm: float
) -> None:
    model = oc4_lower(shared_data)
    found = solve_frames(model, measured(shared_data, trial, model)[::every])
    assert found.converged.all()
    assert 1000 * tracking_error(found.residuals) == pytest.approx(expected_mm, abs=0.05)


def test_a_fifth_of_all_markers_missing_costs_little(shared_data: Path) -> None:
    model = oc4_lower(shared_data)
    truth = solve_frames(model, measured(shared_data, "walking1", model)).state
    y = marker_positions(model, truth)
    y[np.random.default_rng(3).random(y.shape[:2]) < 0.2] = np.nan
    off = turns_off(model, truth, solve_frames(model, y).state)
    assert np.degrees(np.sqrt(np.mean(off**2))) < 0.25
