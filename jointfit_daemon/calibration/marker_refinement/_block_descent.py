r"""Block-coordinate descent: marker positions and poses are optimized in turns.

The only requirement on the model is inverse kinematics for given markers. With fixed poses, the
best positions are a weighted mean of the measured positions in segment axes and the nominal
positions,

.. math::

    p_m = \frac{\sum_t w_{tm} R^T (y_{tm} - t) + \lambda n_m p^0_m}{\sum_t w_{tm} + \lambda n_m}

With Huber's loss the weights are those at the last errors. Both halves lower F; an accelerated
proposal is accepted only if it lowers F, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.calibration.marker_refinement._anderson import Anderson

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.marker_refinement._objective import RefinementProblem

_TOLERANCE = 1e-4
_MOST_ITERATIONS = 30


class Carriers(NamedTuple):
    """Pose of the segment of every marker in every frame."""

    rotations: Array
    """R_world_segment of each marker's segment, shape (T, M, 3, 3)."""
    origins: Array
    """m, shape (T, M, 3)."""
    overturning: float = 0.0
    """Part of F caused by hinges beyond their limits."""


@dataclass(frozen=True, slots=True)
class AlternatingStep:
    """One accepted iterate: marker positions and the poses fitted to them."""

    positions: Array
    carriers: Carriers
    cost: float


def solve_in_turns(
    problem: RefinementProblem,
    follow: Callable[[Array, Array], Carriers],
    on_step: Callable[[AlternatingStep], bool] | None = None,
    *,
    tolerance: float = _TOLERANCE,
) -> list[AlternatingStep]:
    """Refine by turns of inverse kinematics and weighted means.

    Parameters
    ----------
    follow
        Returns the poses for positions, m, shape (M, 3), and weights of squared errors, shape (T,
        M).
    on_step
        Called with every accepted iterate; True ends the iteration.
    tolerance
        Relative decrease of F in one turn below which the iteration ends.

    Returns
    -------
    list of Turn
        The start and every accepted iterate; F decreases.
    """
    turns = _AlternatingSolver(problem, follow)
    path, anderson = [turns.first()], Anderson()
    while len(path) <= _MOST_ITERATIONS:
        last = path[-1]
        plain = turns.means(last)
        guess = anderson.propose(last.positions[problem.free], plain[problem.free])
        new = None
        if guess is not None:
            positions = problem.model.positions.copy()
            positions[problem.free] = guess
            new = turns.follow(positions, last)
            if new.cost >= last.cost:
                anderson.forget()
                new = None
        if new is None:
            new = turns.follow(plain, last)

        if new.cost >= last.cost:  # both halves are at their minimum, except for rounding
            break
        path.append(new)
        done = last.cost - new.cost < tolerance * last.cost
        if done or (on_step is not None and on_step(new)):
            break

    return path


class _AlternatingSolver:
    """The two steps of one turn: poses and positions."""

    def __init__(
        self, problem: RefinementProblem, follow: Callable[[Array, Array], Carriers]
    ) -> None:
        self._problem = problem
        self._follow = follow

    def first(self) -> AlternatingStep:
        begin = self._problem.model.positions
        return self._at(begin, self._follow(begin, self._problem.weights))

    def follow(self, positions: Array, last: AlternatingStep) -> AlternatingStep:
        """Return the poses for new positions, with the robust weights of the last poses."""
        distances = np.linalg.norm(self._errors(positions, last.carriers), axis=-1)
        return self._at(positions, self._follow(positions, self._problem.robust(distances)))

    def means(self, last: AlternatingStep) -> Array:
        """Return the best positions at fixed poses."""
        problem = self._problem
        e = self._errors(last.positions, last.carriers)
        w = problem.robust(np.linalg.norm(e, axis=-1))
        nominal = problem.model.positions
        pulled = (w[..., None] * (last.positions - e)).sum(axis=0) + problem.pull * nominal
        total = w.sum(axis=0)[:, None] + problem.pull
        means = last.positions.copy()
        means[problem.free] = (pulled / np.where(total > 0.0, total, 1.0))[problem.free]
        return means

    def _at(self, positions: Array, carriers: Carriers) -> AlternatingStep:
        distances = np.linalg.norm(self._errors(positions, carriers), axis=-1)
        cost = self._problem.cost(distances, positions) + carriers.overturning
        return AlternatingStep(positions, carriers, cost)

    def _errors(self, positions: Array, carriers: Carriers) -> Array:
        """Return errors in segment axes, shape (T, M, 3); zero where a marker is missing."""
        problem = self._problem
        away = (problem.seen - carriers.origins)[..., None]
        local = (np.swapaxes(carriers.rotations, -1, -2) @ away)[..., 0]
        return np.where((problem.weights > 0.0)[..., None], positions - local, 0.0)
