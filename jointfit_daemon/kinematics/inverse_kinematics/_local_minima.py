"""Detection of local minima of inverse kinematics, and restarts from other poses.

Every instant is solved from its own markers. Single instants or a whole trial may therefore end in
a local minimum. Two kinds of instants are solved again from perturbed poses: instants with an error
well above the error of neighboring instants, and some evenly spaced instants. After an improvement,
the neighbors are solved from the improved pose, as long as their error decreases.

Invariant: the cost of an instant never increases.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import median_filter

from jointfit_daemon.kinematics.chains import apply_step, layout_of
from jointfit_daemon.kinematics.inverse_kinematics._levenberg_marquardt import limits_of
from jointfit_daemon.kinematics.inverse_kinematics._solver import (
    IkOptions,
    IkResult,
    checked_weights,
    solve_frames,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel, ChainState

_SURROUNDINGS = 31
"""Number of instants in the running median of the error."""
_JUMP = 1.5
"""Smallest ratio of the error to its running median that counts as a jump."""
_JUMP_M = 0.003
"""Smallest excess of the error over its running median that counts as a jump, m."""
_PROBES = 24
"""Number of evenly spaced instants that are solved from perturbed poses."""
_POSES = 6
"""Number of perturbed poses per instant."""
_PERTURBATION = 1.0
"""Largest perturbation of a rotation, rad."""
_GOLDEN = 0.6180339887498949
"""Golden ratio minus 1. Its multiples modulo 1 are evenly distributed, and are used as
perturbations instead of random numbers.
"""
_GAIN = 0.99
"""Largest ratio of the new cost to the old cost that counts as an improvement. Smaller differences
result from rounding and from the tolerance of the solver.
"""
_PASSES = 400
"""Largest number of neighbors in one direction that are solved after an improvement."""


def restart_local_minima(
    model: ChainModel,
    markers: ArrayLike,
    weights: ArrayLike | None,
    found: IkResult,
    options: IkOptions | None = None,
) -> tuple[IkResult, NDArray[np.bool_]]:
    """Return a solution without the detected local minima, and the improved instants.

    Parameters
    ----------
    model, markers, weights, options
        Parameters of `solve_frames`.
    found
        Result of `solve_frames`.

    Returns
    -------
    result
        Poses that equal `found` except at the improved instants.
    improved
        Mask of the improved instants, shape (T,).
    """
    measured = np.asarray(markers, dtype=np.float64)
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(measured).all(axis=-1))
    trial = _Trial(model, measured, checked_weights(model, weights, seen), options or IkOptions())
    best = _Best(trial, deepcopy(found))

    # Find the instants with an error well above the running median.
    rms = np.sqrt(best.cost / np.maximum(trial.weights.sum(axis=1), 1e-12))
    usual = median_filter(rms, size=min(_SURROUNDINGS, max(len(rms), 1)), mode="nearest")
    probes = np.union1d(
        np.flatnonzero((rms > _JUMP * usual) & (rms > usual + _JUMP_M)),
        np.linspace(0, len(measured) - 1, min(_PROBES, len(measured))).astype(np.intp),
    )
    for k in range(_POSES if len(measured) else 0):
        # The k-th perturbation of the rotations, rad, shape (len(probes), nq).
        layout = layout_of(model)
        numbers = np.arange(1, model.nq + 1) * (k + 1) * _GOLDEN
        step = _PERTURBATION * (2.0 * (numbers % 1.0) - 1.0)
        step[layout.shifts] = 0.0
        start = apply_step(
            model, best.result.state.take(probes), np.broadcast_to(step, (len(probes), model.nq))
        )
        best.try_from(probes, start)

    # Start the neighbors of improved instants from the improved poses, while the cost decreases.
    last = np.flatnonzero(best.improved)
    for _ in range(_PASSES):
        ahead = [(last + s, last) for s in (-1, 1)]
        at = np.concatenate([to for to, _ in ahead])
        source = np.concatenate([of for _, of in ahead])
        inside = (at >= 0) & (at < len(measured))
        at, first = np.unique(at[inside], return_index=True)
        if not at.size:
            break
        last = at[best.try_from(at, best.result.state.take(source[inside][first]))]

    return best.result, best.improved


@dataclass(frozen=True, slots=True)
class _Trial:
    model: ChainModel
    measured: Array
    weights: Array
    options: IkOptions

    def cost(self, residuals: Array, state: ChainState, at: NDArray[np.intp]) -> Array:
        """Return the weighted squared errors and excesses over limits, m^2, shape (len(at),)."""
        square = np.einsum("tmi,tmi->tm", residuals, residuals)
        cost = np.where(self.weights[at] > 0.0, self.weights[at] * square, 0.0).sum(axis=1)
        for band in limits_of(self.model, self.options.limit_m2):
            excess = band.excess(layout_of(self.model), state)
            cost = cost + (band.weights * excess**2).sum(axis=1)
        return np.asarray(cost)


class _Best:
    """Best known solution of a trial, overwritten in place."""

    def __init__(self, trial: _Trial, result: IkResult) -> None:
        self._trial, self.result = trial, result
        every = np.arange(len(trial.measured))
        self.cost = trial.cost(result.residuals, result.state, every)
        self.improved = np.zeros(len(every), dtype=np.bool_)

    def try_from(self, at: NDArray[np.intp], start: ChainState) -> NDArray[np.bool_]:
        """Solve some instants from other states; return a mask of the improved instants."""
        trial = self._trial
        new = solve_frames(
            trial.model, trial.measured[at], trial.weights[at], start=start, options=trial.options
        )
        cost = trial.cost(new.residuals, new.state, at)
        better = (cost < _GAIN * self.cost[at]) & ~new.underdetermined
        to = at[better]
        self.cost[to], self.improved[to] = cost[better], True
        self.result.state.put(to, new.state.take(better))
        for f in fields(new):
            if f.name != "state":
                getattr(self.result, f.name)[to] = getattr(new, f.name)[better]
        return better
