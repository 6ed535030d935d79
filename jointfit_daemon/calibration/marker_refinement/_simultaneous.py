r"""Bundle adjustment of markers and poses: Gauss-Newton with Schur elimination of the poses.

The module `_objective` defines the objective F and the error e of marker m in frame t. Frames are
coupled only through the markers, so the normal equations have one small block for each frame. With
errors in segment axes and :math:`J_{tm} = \partial e/\partial q`,

.. math::

    A_t = \sum_m J_{tm}^T J_{tm}, \quad B_{tm} = J_{tm}^T, \quad
    S = C - \sum_t B_t^T A_t^{-1} B_t, \quad
    \delta p = -S^{-1} (h - \sum_t B_t^T A_t^{-1} g_t), \quad
    \delta q_t = -A_t^{-1} (g_t + B_t\, \delta p)

where p are the marker positions, q the poses, g and h the gradients of F with respect to q and p,
and C is the marker block of the normal matrix. :math:`B_t` consists of the blocks :math:`B_{tm}` of
all markers. All terms include the weights. A step is accepted
only if F decreases. Source: the elimination is the variable projection of Golub and Pereyra, SIAM
J. Numer. Anal. 10 (1973), 413, in the form that is used in bundle adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics.chains import ChainState, apply_step, jacobian, segment_poses

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.marker_refinement._objective import RefinementProblem

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e-12, 1e9
_FLOOR = 1e-11
"""Constant that is added to the diagonal of A_t, so that degrees of freedom without markers do not
change.
"""
_TOLERANCE = 1e-6
"""Relative decrease of F below which the iteration ends."""
_MOST_ITERATIONS = 30
"""Largest number of steps."""
_FRAMES_AT_ONCE = 128
"""Number of frames whose blocks are in memory at once."""


@dataclass(frozen=True, slots=True)
class RefinementStep:
    """One accepted iterate of marker positions and poses."""

    positions: Array
    state: ChainState
    cost: float


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Blocks for T frames, f unlocked coordinates and nq degrees of freedom."""

    A: Array
    """Pose block A_t of each frame, shape (T, nq, nq)."""
    B: Array
    """Coupling block B_t of poses and markers of each frame, shape (T, nq, f)."""
    g: Array
    """Gradient with respect to the pose of each frame, shape (T, nq)."""
    h: Array
    """Gradient with respect to the unlocked marker coordinates, shape (f,)."""
    C: Array
    """Diagonal of the marker block C, shape (f,)."""

    def solve(self, damping: float) -> tuple[Array, Array]:
        """Return the step of the markers, shape (f,), and of the poses, shape (T, nq)."""
        solved, S, r = self._eliminate(damping)
        dp = np.asarray(-np.linalg.solve(S, self.h - r), dtype=np.float64)
        return dp, -(solved[..., -1] + solved[..., :-1] @ dp)

    def reduced(self) -> Array:
        """Return S without damping, shape (f, f)."""
        return self._eliminate(0.0)[1]

    def _eliminate(self, damping: float) -> tuple[Array, Array, Array]:
        nq = self.A.shape[-1]
        A = self.A + _FLOOR * np.eye(nq)
        A[:, range(nq), range(nq)] += damping * self.A[:, range(nq), range(nq)]
        both = np.concatenate((self.B, self.g[..., None]), axis=-1)
        solved = np.asarray(np.linalg.solve(A, both), dtype=np.float64)
        f = len(self.C)
        product = self.B.reshape(-1, f).T @ solved.reshape(-1, f + 1)
        S: Array = np.diag(self.C * (1.0 + damping)) - product[:, :f]
        return solved, S, product[:, f]


def errors(problem: RefinementProblem, positions: Array, state: ChainState) -> Array:
    """Return the errors in segment axes, m, shape (T, M, 3); zero where a marker is missing."""
    R, t = segment_poses(problem.model, state)
    s = problem.model.marker_segments
    local = (np.swapaxes(R[:, s], -1, -2) @ (problem.seen - t[:, s])[..., None])[..., 0]
    return np.where((problem.weights > 0.0)[..., None], positions - local, 0.0)


def linearize(problem: RefinementProblem, positions: Array, state: ChainState) -> NormalEquations:
    """Return the normal equations at an iterate."""
    model = problem.model.with_markers(positions)
    e = errors(problem, positions, state)
    root = np.sqrt(problem.robust(np.linalg.norm(e, axis=-1)))
    free = problem.free.ravel()
    parts = []

    for start in range(0, len(state), _FRAMES_AT_ONCE):
        some = slice(start, start + _FRAMES_AT_ONCE)
        at = state.take(some)
        R = segment_poses(model, at)[0][:, model.marker_segments]
        J = np.swapaxes(R, -1, -2) @ jacobian(model, at) * root[some, :, None, None]
        X = np.swapaxes(J.reshape(len(at), -1, J.shape[-1]), -1, -2)
        w = np.repeat(root[some], 3, axis=1)
        A, B = X @ np.swapaxes(X, -1, -2), X[..., free] * w[:, None, free]
        parts.append((A, B, (X @ (w * e[some].reshape(len(at), -1))[..., None])[..., 0]))

    A, B, g = (np.concatenate(part) for part in zip(*parts, strict=True))
    excess = problem.excess(state)
    if excess is not None:
        np.einsum("tkk->tk", A)[...] += problem.limit_m2 * (excess != 0.0)
        g += problem.limit_m2 * excess

    total = (root**2).sum(axis=0)
    h = ((root**2)[..., None] * e).sum(axis=0)
    h += problem.pull * (positions - problem.model.positions)
    C = total[:, None] + problem.pull

    return NormalEquations(A, B, g, h.ravel()[free], C.ravel()[free])


def solve_simultaneously(
    problem: RefinementProblem,
    start: RefinementStep,
    on_step: Callable[[RefinementStep], bool] | None = None,
    tolerance: float = _TOLERANCE,
) -> list[RefinementStep]:
    """Refine by Gauss-Newton steps, each of which decreases F.

    Parameters
    ----------
    problem
        The objective F with its data.
    start
        Nominal positions and the poses that were fitted to them.
    on_step
        Function that is called with every accepted iterate. If it returns True, the iteration ends.
    tolerance
        Relative decrease of F below which the iteration ends.

    Returns
    -------
    list of RefinementStep
        The start and every accepted iterate.
    """
    steps, damping = [start], _FIRST_DAMPING
    while len(steps) <= _MOST_ITERATIONS:
        last = steps[-1]
        taken, damping = _improve(problem, last, damping)
        if taken is None:
            break
        steps.append(taken)
        done = last.cost - taken.cost < tolerance * last.cost
        if done or (on_step is not None and on_step(taken)):
            break

    return steps


def place(problem: RefinementProblem, positions: Array, state: ChainState) -> RefinementStep:
    """Return an iterate with its cost."""
    distances = np.linalg.norm(errors(problem, positions, state), axis=-1)
    cost = problem.cost(distances, positions) + problem.overturning(state)
    return RefinementStep(positions, state, cost)


def _improve(
    problem: RefinementProblem, last: RefinementStep, damping: float
) -> tuple[RefinementStep | None, float]:
    """Return the next iterate, or None if no step lowers the cost, and the next damping."""
    equations = linearize(problem, last.positions, last.state)
    while damping <= _MOST_DAMPING:
        dp, dq = equations.solve(damping)
        positions = last.positions.copy()
        positions[problem.free] += dp
        new = place(problem, positions, apply_step(problem.model, last.state, dq))
        if new.cost < last.cost:
            return new, max(0.2 * damping, _LEAST_DAMPING)
        damping *= 10.0

    return None, damping
