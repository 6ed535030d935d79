"""Simultaneous refinement of markers and poses on a chain with known ground truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import pytest
from scipy.optimize import least_squares

from jointfit_daemon.calibration import RefinementCost
from jointfit_daemon.calibration.marker_refinement import (
    MotionTrial,
    RefinementError,
    RefinementSettings,
    _refine,
    refine_markers,
)
from jointfit_daemon.calibration.marker_refinement._objective import RefinementProblem
from jointfit_daemon.calibration.marker_refinement._simultaneous import (
    errors,
    place,
    solve_simultaneously,
)
from jointfit_daemon.kinematics.chains import (
    ChainModel,
    ChainState,
    Joint,
    Marker,
    Segment,
    apply_step,
    marker_positions,
    rest_state,
)
from jointfit_daemon.kinematics.inverse_kinematics import IkOptions, solve_frames, tracking_error

if TYPE_CHECKING:
    from jointfit_daemon.calibration import RefinementMethod
    from jointfit_daemon.kinematics.inverse_kinematics import IkResult

LOCKED = (True, True, True)


def limb() -> ChainModel:
    """Return a chain of pelvis, thigh and shank with five markers each.

    All pelvis markers, and the first two markers of thigh and shank, are locked.
    """
    rng = np.random.default_rng(3)
    segments = (
        Segment("pelvis"),
        Segment("thigh", "pelvis", Joint("ball", (0.1, 0.0, -0.1))),
        Segment("shank", "thigh", Joint("hinge", (0.0, 0.0, -0.4))),
    )
    middles = {"pelvis": (0.0, 0.0, 0.0), "thigh": (0.0, 0.0, -0.2), "shank": (0.0, 0.0, -0.2)}
    markers = [
        Marker(f"{name}{k}", name, tuple((rng.normal(0.0, 0.07, 3) + middle).tolist()))
        for name, middle in middles.items()
        for k in range(5)
    ]
    held = {f"{name}{k}": LOCKED for name in middles for k in range(2)}
    held |= {f"pelvis{k}": LOCKED for k in range(5)}
    return ChainModel(tuple(segments), tuple(markers)).with_locks(held)


@cache
def walk(frames: int = 60) -> ChainState:
    model = limb()
    t = np.linspace(0.0, 2 * np.pi, frames)[:, None]
    phase = np.linspace(0.0, 3.0, model.nq)
    swing = np.array([0.3] * 3 + [0.2] * 3 + [0.6] * 3 + [0.8])
    return apply_step(model, rest_state(model, frames), swing * np.sin(t + phase))


def seen(noise: float = 0.0, seed: int = 0) -> np.ndarray:
    clean = marker_positions(limb(), walk())
    return clean + np.random.default_rng(seed).normal(0.0, noise, clean.shape)


def misplaced(model: ChainModel, spread: float = 0.01) -> ChainModel:
    off = np.random.default_rng(5).normal(0.0, spread, model.positions.shape)
    return model.with_markers(model.positions + np.where(model.locked, 0.0, off))


@pytest.mark.parametrize("method", ["joint", "block"])
def test_without_noise_the_true_marker_positions_are_found(method: RefinementMethod) -> None:
    settings = RefinementSettings(method, prior=1e-6, huber_m=None, tolerance=1e-14)
    trial = MotionTrial("walk", seen(), 100.0)
    found = refine_markers(misplaced(limb()), [trial], settings)
    tolerance = 1e-4 if method == "joint" else 1e-3  # block descent converges slowly
    np.testing.assert_allclose(found.model.positions, limb().positions, atol=tolerance)


def test_the_step_is_that_of_the_whole_least_squares_problem() -> None:
    """The expected result is computed by SciPy, which solves for poses and markers together."""
    model, y = misplaced(limb()), seen(0.003)[::10]
    weights, free = np.ones(y.shape[:2]), ~model.locked
    problem = RefinementProblem(model, y, weights, free, 0.1, None)
    start = place(problem, model.positions, solve_frames(model, y).state)

    def residuals(z: np.ndarray) -> np.ndarray:
        positions = model.positions.copy()
        positions[free] += z[: free.sum()]
        state = apply_step(model, start.state, z[free.sum() :].reshape(len(y), -1))
        pull = np.sqrt(problem.pull) * (positions - model.positions)
        return np.concatenate((errors(problem, positions, state).ravel(), pull.ravel()))

    whole = least_squares(residuals, np.zeros(free.sum() + len(y) * model.nq), xtol=1e-12)
    ended = solve_simultaneously(problem, start, tolerance=1e-12)[-1]
    assert ended.cost == pytest.approx(whole.cost, rel=1e-6)
    np.testing.assert_allclose(
        ended.positions[free] - model.positions[free], whole.x[: free.sum()], atol=1e-5
    )


@pytest.mark.parametrize("method", ["joint", "block"])
@pytest.mark.parametrize("huber", [None, 0.004])
def test_cost_of_the_refinement_never_increases(
    method: RefinementMethod, huber: float | None
) -> None:
    settings = RefinementSettings(method, huber_m=huber)
    trial = MotionTrial("walk", seen(0.004), 100.0)
    costs = refine_markers(misplaced(limb(), 0.015), [trial], settings).costs
    assert len(costs) > 2
    assert (np.diff(costs) < 0.0).all()


def test_locked_coordinates_stay_to_the_last_digit() -> None:
    model = misplaced(limb()).with_locks({"shank3": (False, True, False)})
    found = refine_markers(model, [MotionTrial("walk", seen(0.002), 100.0)])
    kept = found.model.locked
    np.testing.assert_array_equal(found.model.positions[kept], model.positions[kept])
    assert (found.model.positions[~kept] != model.positions[~kept]).all()


def test_huber_loss_reduces_the_effect_of_an_outlier_marker() -> None:
    y = seen(0.001)
    y[:20, 8] += 0.08  # thigh3 slips for a third of the trial
    off = {}
    for huber in (None, 0.01):
        settings = RefinementSettings(prior=0.001, huber_m=huber)
        found = refine_markers(limb(), [MotionTrial("walk", y, 100.0)], settings)
        off[huber] = np.linalg.norm(found.model.positions - limb().positions, axis=-1).max()
    assert off[0.01] < 0.5 * off[None]


def test_joint_angles_improve_if_markers_on_bone_are_locked() -> None:
    found = refine_markers(misplaced(limb()), [MotionTrial("walk", seen(0.003), 100.0)])
    truth = walk().rotations
    off = [
        np.abs(solve_frames(m, seen()).state.rotations - truth).mean()
        for m in (misplaced(limb()), found.model)
    ]
    assert off[1] < 0.5 * off[0]
    assert found.trials[0].after.rms < 0.6 * found.trials[0].before.rms


def test_a_holdout_ends_the_iteration_with_the_best_positions() -> None:
    trial = MotionTrial("walk", seen(0.004), 100.0)
    settings = RefinementSettings(prior=1e-6, holdout_share=0.3)
    found = refine_markers(misplaced(limb()), [trial], settings)
    held = trial.split(0.3)[1]
    assert len(held.targets) == 18
    better = solve_frames(found.model, held.targets).residuals
    worse = solve_frames(misplaced(limb()), held.targets).residuals
    assert np.mean(better**2) < np.mean(worse**2)


def clamped() -> ChainModel:
    """Return the limb with knee limits that its walking movement exceeds by up to 17 degrees."""
    model = limb()
    hip, knee = model.segments[1:]
    short = replace(knee, joint=replace(knee.joint, limits=(-0.5, 1.0)))
    return replace(model, segments=(model.segments[0], hip, short))


def test_with_joint_limits_markers_fit_a_program_that_clamps_its_joints() -> None:
    model, trial = clamped(), MotionTrial("walk", seen(0.002), 100.0)
    model = model.with_locks(dict.fromkeys(model.marker_names[5:], (False,) * 3))
    rms = {}
    for limit in (0.0, 1.0):
        found = refine_markers(model, [trial], RefinementSettings(limit_m2=limit))
        hard = solve_frames(found.model, trial.targets, options=IkOptions(limit_m2=1.0))
        rms[limit] = tracking_error(hard.residuals)
        if limit:
            assert found.trials[0].after.rms == pytest.approx(rms[limit], rel=0.01)
    assert rms[1.0] < 0.8 * rms[0.0]


def test_both_methods_find_the_same_within_limits() -> None:
    """With joint limits, both refinement methods end with the same cost."""
    trial, ends = MotionTrial("walk", seen(0.002), 100.0), []
    methods: tuple[RefinementMethod, ...] = ("joint", "block")
    for method in methods:
        settings = RefinementSettings(method, tolerance=1e-7)
        costs = refine_markers(clamped(), [trial], settings).costs
        assert (np.diff(costs) < 0.0).all()
        ends.append(costs[-1])
    assert ends[0] == pytest.approx(ends[1], rel=1e-3)


def test_trials_are_thinned_evenly_and_split_in_two_runs_of_frames() -> None:
    trial = MotionTrial("a", np.arange(100.0)[:, None, None] * np.ones((1, 2, 3)), 100.0)
    thin = trial.thin(30)
    np.testing.assert_array_equal(thin.targets[:, 0, 0], np.arange(0.0, 100.0, 4.0))
    assert thin.rate_hz == 25.0
    first, last = trial.split(0.25)
    np.testing.assert_array_equal(np.concatenate((first.targets, last.targets)), trial.targets)
    assert len(last.targets) == 25


@pytest.mark.parametrize("method", ["joint", "block"])
def test_cost_l1_reduces_the_effect_of_a_marker_that_is_often_far_off(
    method: RefinementMethod,
) -> None:
    y = seen(0.001)
    y[:20, 8] += 0.02  # this error of thigh3 is below the Huber threshold of the squared cost
    off: dict[RefinementCost, float] = {}
    for cost in get_args(RefinementCost):
        settings = RefinementSettings(method, prior=0.001, cost=cost)
        found = refine_markers(limb(), [MotionTrial("walk", y, 100.0)], settings)
        off[cost] = np.linalg.norm(found.model.positions - limb().positions, axis=-1).max()
    assert off["l1"] < 0.3 * off["l2"]


def test_cost_l1_is_refused_for_the_search() -> None:
    settings = RefinementSettings("search", cost="l1")
    with pytest.raises(RefinementError, match="method search"):
        refine_markers(limb(), [MotionTrial("walk", seen(), 100.0)], settings)


def test_a_marker_of_small_weight_has_little_influence() -> None:
    y = seen()
    y[:20, 8] += 0.015
    trial = MotionTrial("walk", y, 100.0)
    off = {}
    for weight in (1.0, 0.01):
        model = limb()
        markers = list(model.markers)
        markers[8] = replace(markers[8], weight=weight)
        found = refine_markers(replace(model, markers=tuple(markers)), [trial])
        others = np.delete(found.model.positions - model.positions, 8, axis=0)
        off[weight] = np.abs(others).max()
    assert off[0.01] < 0.1 * off[1.0]


def test_frames_in_a_local_minimum_are_solved_again_and_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = 0

    def stuck(model: ChainModel, *args: Any, **options: Any) -> IkResult:
        nonlocal calls
        found = solve_frames(model, *args, **options)
        calls += 1
        if calls > 1:
            return found
        step = np.zeros((len(found.state), model.nq))
        step[20:30, -1] = 2.5
        state = apply_step(model, found.state, step)
        return replace(found, state=state, residuals=marker_positions(model, state) - args[0])

    trial = MotionTrial("walk", seen(0.001), 100.0)
    right = refine_markers(misplaced(limb()), [trial])
    assert right.notes == ()
    monkeypatch.setattr(_refine, "solve_frames", stuck)
    found = refine_markers(misplaced(limb()), [trial])
    assert any("10 of 60 training frames" in note for note in found.notes)
    assert found.model.positions == pytest.approx(right.model.positions, abs=1e-5)
