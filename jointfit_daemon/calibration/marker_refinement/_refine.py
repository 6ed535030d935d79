"""Refinement of the marker positions of a chain model, from trials to the complete result.

Training frames, hold-out frames that determine the end of the iteration, and validation trials have
no frames in common.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.marker_refinement._block_descent import Carriers, solve_in_turns
from jointfit_daemon.calibration.marker_refinement._coordinate_search import search
from jointfit_daemon.calibration.marker_refinement._evaluation import (
    evaluate_trial,
    marker_outcomes,
)
from jointfit_daemon.calibration.marker_refinement._gauge import Gauge, gauge_of
from jointfit_daemon.calibration.marker_refinement._input_checks import CheckedTrials, check
from jointfit_daemon.calibration.marker_refinement._motion_trial import (
    RefinementError,
    RefinementSettings,
)
from jointfit_daemon.calibration.marker_refinement._objective import RefinementProblem
from jointfit_daemon.calibration.marker_refinement._refinement_result import Refinement
from jointfit_daemon.calibration.marker_refinement._simultaneous import (
    linearize,
    place,
    solve_simultaneously,
)
from jointfit_daemon.kinematics.inverse_kinematics import (
    IkOptions,
    IkResult,
    restart_local_minima,
    solve_frames,
    tracking_error,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.marker_refinement._motion_trial import MotionTrial
    from jointfit_daemon.kinematics.chains import ChainModel

    Progress = Callable[[float, float], None]
    """Function that is called with the completed fraction, 0 to 1, and the training error, m."""
    Stop = Callable[[], bool]
    """Function that is called during the iteration. If it returns true, the iteration ends with the
    current positions.
    """

L1_CORNER_M = 0.001
"""Distance below which the loss of the cost ``l1`` is quadratic, m. The quadratic part makes the
derivative of the loss continuous at zero.
"""
_FINE = 1e-9
STOPPED = "stopped before convergence"
"""Value of `Refinement.stopped` if the caller ended the iteration."""
_RISES = 2
"""Number of consecutive steps without a new minimum of the hold-out error that ends the
iteration."""


def refine_markers(
    model: ChainModel,
    trials: Sequence[MotionTrial],
    settings: RefinementSettings | None = None,
    validation: Sequence[MotionTrial] = (),
    progress: Progress | None = None,
    *,
    stop: Stop | None = None,
) -> Refinement:
    """Refine the positions of markers on their segments.

    Parameters
    ----------
    model
        Chain model with nominal marker positions, locked coordinates and marker weights.
    trials
        Training trials.
    settings
        Method and weights of the refinement; `RefinementSettings()` by default.
    validation
        Trials that are evaluated but not fitted.
    progress
        Function that is called after every step with the completed share, 0 to 1, and the training
        error, m. The error is an RMS error for ``search``, and √(2F/Σw) with the cost F and the
        weights w for the other methods. ``search`` calls the function after every pass over the
        coordinates.
    stop
        Function that is called after every step, and by ``search`` before every coordinate. If it
        returns true, the refinement stops and returns the result of the completed steps.

    Returns
    -------
    Refinement
        Result. If frames are held out, ``joint`` and ``block`` select the step with the smallest
        hold-out error.

    Raises
    ------
    RefinementError
        The checks of the inputs found a fault, such as a wrong length unit, exchanged labels or too
        few frames.
    """
    settings = settings or RefinementSettings()
    if settings.cost == "l1" and settings.method == "search":
        raise RefinementError("cost l1: method search has no loss function; use joint or block")
    thin = [trial.thin(settings.frames) for trial in trials]
    unseen = [trial.thin(settings.frames) for trial in validation]
    checked = check(model, thin, unseen)
    task = _task(model, checked, settings)
    control = _RunControl(progress or (lambda _share, _error: None), stop or (lambda: False))
    ended = _METHODS[settings.method](task, settings, control)
    after = model.with_markers(ended.positions)
    within = IkOptions(limit_m2=settings.limit_m2)
    outcomes = tuple(
        evaluate_trial(model, after, t, trained=n < len(thin), options=within)
        for n, t in enumerate((*checked.trials, *unseen))
    )

    rates = sorted({round(trial.rate_hz, 6) for trial in (*trials, *validation)})
    notes = checked.notes
    if task.restarted:
        notes += (
            f"{task.restarted} of {len(task.problem.targets)} training frames started in a local"
            " minimum of inverse kinematics; they were solved again from other poses",
        )
    if len(rates) > 1:
        listed = ", ".join(f"{rate:g}" for rate in rates)
        notes += (f"recorded at {listed} Hz: trials are weighted by frames, not by duration",)
    return Refinement(
        after,
        settings.method,
        settings.prior,
        marker_outcomes(model, after, checked.free, outcomes),
        outcomes,
        ended.costs,
        ended.runs,
        ended.stopped,
        _gauge(task, ended.positions, settings),
        notes,
    )


@dataclass(frozen=True, slots=True)
class _RunControl:
    progress: Progress
    stop: Stop


@dataclass(frozen=True, slots=True)
class _RefinementTask:
    problem: RefinementProblem
    first: IkResult
    """Poses of the training frames at the nominal positions."""
    holdout: _HoldOut | None
    restarted: int
    """Number of training frames whose error decreased after a restart from another pose."""


@dataclass(frozen=True, slots=True)
class _RefinementEnd:
    positions: Array
    costs: tuple[float, ...]
    runs: int
    stopped: str


def _task(
    model: ChainModel, checked: CheckedTrials, settings: RefinementSettings
) -> _RefinementTask:
    parts = [trial.split(settings.holdout_share) for trial in checked.trials]
    targets = np.concatenate([part.targets for part, _ in parts])
    present = np.isfinite(targets).all(axis=-1)
    weights = present * model.weights
    problem = RefinementProblem(
        model,
        targets,
        weights,
        checked.free,
        settings.prior,
        settings.huber_m,
        settings.limit_m2,
    )
    options = IkOptions(huber_m=settings.huber_m, limit_m2=settings.limit_m2)
    first = solve_frames(model, targets, weights, options=options)
    first, improved = restart_local_minima(model, targets, weights, first, options)
    if settings.cost == "l1":
        # The weight of a typical error is smaller with the l1 loss than with the l2 loss, by the
        # factor L1_CORNER_M / error. The prior is scaled by the same factor.
        typical = float(np.nanmedian(np.linalg.norm(first.residuals, axis=-1)))
        weaker = min(1.0, L1_CORNER_M / max(typical, L1_CORNER_M))
        problem = replace(problem, huber_m=L1_CORNER_M, prior=weaker * settings.prior)
    if settings.evenness > 0.0:
        # The frames of a trial are weighted by a power of the trial's tracking error. The weights
        # are scaled to mean 1, so that the relative weight of the prior is unchanged.
        lengths = [len(part.targets) for part, _ in parts]
        each = np.split(first.residuals, np.cumsum(lengths)[:-1])
        errors = np.array([tracking_error(part) for part in each])
        even = np.repeat(errors**settings.evenness, lengths)
        problem = replace(problem, weights=weights * np.asarray(even / even.mean())[:, None])

    held = [part.targets for _, part in parts if len(part.targets)]
    within = IkOptions(limit_m2=settings.limit_m2)
    holdout = _HoldOut(model, np.concatenate(held), within) if held else None
    return _RefinementTask(problem, first, holdout, int(improved.sum()))


class _HoldOut:
    """Hold-out frames, whose error determines when the iteration stops."""

    def __init__(self, model: ChainModel, targets: Array, options: IkOptions) -> None:
        self._model, self._targets, self._options = model, targets, options
        self._last = solve_frames(model, targets, options=options)
        self._best = tracking_error(self._last.residuals)
        self._rises = 0
        self.positions = model.positions

    def enough(self, positions: Array) -> bool:
        """Record the hold-out error at new positions; return whether the iteration must stop.

        The iteration stops after `_RISES` consecutive steps without a new minimum.
        """
        model = self._model.with_markers(positions)
        self._last = solve_frames(
            model, self._targets, start=self._last.state, options=self._options
        )
        error = tracking_error(self._last.residuals)
        self._rises = self._rises + 1 if error >= self._best else 0
        if error < self._best:
            self._best, self.positions = error, positions
        return self._rises >= _RISES


def _refine_simultaneously(
    task: _RefinementTask, settings: RefinementSettings, control: _RunControl
) -> _RefinementEnd:
    problem = task.problem
    start = place(problem, problem.model.positions, task.first.state)
    watch = _StopCriterion(task.holdout, problem, control)
    tolerance = settings.tolerance or 1e-6
    steps = solve_simultaneously(problem, start, lambda s: watch(s.positions, s.cost), tolerance)
    return watch.finish(steps[-1].positions, [s.cost for s in steps], 1)


def _refine_by_blocks(
    task: _RefinementTask, settings: RefinementSettings, control: _RunControl
) -> _RefinementEnd:
    problem = task.problem
    chain = ChainFollower(problem, task.first)
    watch = _StopCriterion(task.holdout, problem, control)
    tolerance = settings.tolerance or 1e-4
    turns = solve_in_turns(
        problem, chain, lambda t: watch(t.positions, t.cost), tolerance=tolerance
    )
    return watch.finish(turns[-1].positions, [t.cost for t in turns], chain.runs)


def _refine_by_search(
    task: _RefinementTask, settings: RefinementSettings, control: _RunControl
) -> _RefinementEnd:
    problem, last = task.problem, task.first
    present = problem.weights > 0.0
    within = IkOptions(limit_m2=settings.limit_m2)

    def error(positions: Array) -> float:
        nonlocal last
        model = problem.model.with_markers(positions)
        last = solve_frames(
            model, problem.targets, problem.weights, start=last.state, options=within
        )
        distances = np.linalg.norm(last.residuals, axis=-1)

        return float(np.sqrt(np.mean(distances[present] ** 2)))

    first_step = settings.search.first_step_m

    def report(step: float, at: float) -> None:
        halvings = np.log2(first_step / step) if step > 0 else np.inf
        all_of_them = np.log2(first_step / settings.search.threshold_m) + 1.0
        control.progress(min(1.0, float(halvings / all_of_them)), at)

    start = problem.model.positions
    found = search(error, start, problem.free, settings.search, report, stop=control.stop)
    stopped = "every step is below the threshold" if found.complete else STOPPED
    return _RefinementEnd(found.positions, found.errors, found.runs, stopped)


_METHODS = {
    "joint": _refine_simultaneously,
    "block": _refine_by_blocks,
    "search": _refine_by_search,
}


class ChainFollower:
    """Inverse kinematics of the chain for `solve_in_turns`. Each run starts from the last poses."""

    def __init__(self, problem: RefinementProblem, first: IkResult) -> None:
        self._problem, self._state = problem, first.state
        self.runs = 0

    def __call__(self, positions: Array, weights: Array) -> Carriers:
        """Return the poses fitted to the markers at these positions."""
        model = self._problem.model.with_markers(positions)
        fine = IkOptions(tolerance=_FINE, limit_m2=self._problem.limit_m2)
        found = solve_frames(model, self._problem.targets, weights, start=self._state, options=fine)
        self._state = found.state
        self.runs += 1
        s = model.marker_segments
        beyond = self._problem.overturning(found.state)
        return Carriers(found.rotations[:, s], found.origins[:, s], beyond)


class _StopCriterion:
    """Reports progress after every step and decides whether the iteration stops."""

    def __init__(
        self, holdout: _HoldOut | None, problem: RefinementProblem, control: _RunControl
    ) -> None:
        self._holdout, self._control = holdout, control
        self._total = float(problem.weights.sum())
        self._count = 0
        self._early = self._stopped = False

    def __call__(self, positions: Array, cost: float) -> bool:
        self._count += 1
        self._control.progress(1.0 - 0.5**self._count, float(np.sqrt(2.0 * cost / self._total)))
        self._early = self._holdout is not None and self._holdout.enough(positions)
        self._stopped = not self._early and self._control.stop()
        return self._early or self._stopped

    def finish(self, positions: Array, costs: Sequence[float], runs: int) -> _RefinementEnd:
        stopped = "the hold-out error rose" if self._early else "converged"
        stopped = STOPPED if self._stopped else stopped
        if self._holdout is not None:
            positions = self._holdout.positions
        return _RefinementEnd(positions, tuple(costs), runs, stopped)


def _gauge(task: _RefinementTask, positions: Array, settings: RefinementSettings) -> Gauge:
    plain = replace(task.problem, prior=0.0, huber_m=None, limit_m2=0.0)
    model = plain.model.with_markers(positions)
    state = solve_frames(model, plain.targets, plain.weights, start=task.first.state).state
    names = np.repeat([m.name for m in model.markers], 3)[plain.free.ravel()]
    S = linearize(plain, positions, state).reduced()
    prior = 0.0 if settings.method == "search" else task.problem.prior
    return gauge_of(S, len(state), names.tolist(), prior=prior)
