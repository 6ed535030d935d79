r"""Block-coordinate descent, which optimizes poses and marker positions alternately.

The module `_objective` defines the objective F and the symbols. In each turn an inverse kinematics
solver first computes the poses for given marker positions. With fixed poses, F is then minimized by
a weighted mean of the measured positions in segment axes and the nominal positions,

.. math::

    p_m = \frac{\sum_t w_{tm} R_{tm}^T (y_{tm} - t_{tm}) + \lambda n_m p^0_m}
               {\sum_t w_{tm} + \lambda n_m}

With the Huber loss, :math:`w_{tm}` is multiplied by the robust weight at the errors of the previous
turn. The pose step and the position step each decrease F. Anderson acceleration proposes a further
step, which is accepted only if it also decreases F.
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
"""Relative decrease of F in one turn below which the iteration ends."""
_MOST_ITERATIONS = 30
"""Largest number of turns."""


class Carriers(NamedTuple):
    """Pose of the segment of every marker in every frame."""

    rotations: Array
    """R_world_segment of each marker's segment, shape (T, M, 3, 3) for T frames and M markers."""
    origins: Array
    """Origin of each marker's segment in the world, m, shape (T, M, 3)."""
    overturning: float = 0.0
    """Term of F for the excess of hinge angles over their limits."""


@dataclass(frozen=True, slots=True)
class AlternatingStep:
    """One accepted iterate, with marker positions and the poses fitted to them."""

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
    problem
        The objective F with its data.
    follow
        Function that solves inverse kinematics. Its arguments are marker positions, m, shape (M,
        3), and the weights of their squared errors, shape (T, M). It returns the poses.
    on_step
        Function that is called with every accepted iterate. If it returns True, the iteration ends.
    tolerance
        Relative decrease of F in one turn below which the iteration ends.

    Returns
    -------
    list of AlternatingStep
        The start and every accepted iterate in order. F decreases from each iterate to the next.
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

        if new.cost >= last.cost:  # converged, except for rounding
            break
        path.append(new)
        done = last.cost - new.cost < tolerance * last.cost
        if done or (on_step is not None and on_step(new)):
            break

    return path


class _AlternatingSolver:
    """Computes the pose step and the position step of one turn."""

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
        """Return the positions that minimize F at fixed poses."""
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
