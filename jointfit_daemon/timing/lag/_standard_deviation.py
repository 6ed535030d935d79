r"""How far a fitted lag may be off: a standard deviation that trusts nothing about the residuals.

Law: pure; judges a finished fit, changes nothing. Residuals of low-passed rates are correlated
over the filter's memory, and where the two bodies or the two systems disagree (skin, lens, gyro
scale) over whole movements. So the variance is taken in several ways and the largest one counts:

* the delete-a-block jackknife (Tukey; Künsch 1989): the lag without each stretch of the window,
  with at most 20 stretches, none shorter than the filter's memory, and with half as many
  again and again while five remain. It needs no model of the residuals, and a stretch that
  everything rests on betrays itself;
* Newey and West (1987), residuals correlated over the shortest of these stretches.

A variance from few stretches is itself a guess. :math:`\nu + 1 = (\sum h)^2/\sum h^2` counts the
stretches that carry the information h about the lag, and the finest scale is widened by the
quantile of Student's t with :math:`\nu` degrees of freedom over the normal one as rare, so that no
more windows are far off than the normal distribution lets be. Coarser scales only look for what
lasts, and are widened by :math:`\nu/(\nu-2)`, the variance of t. One tap in a window of rest leaves
nothing to count, and the answer is infinite.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.timing.lag._angular_rates import Floats

RIDGE = 1e-9
"""Relative, on the rotation: motion about one axis leaves it open about that axis."""
LEAST_BLOCKS = 5
MOST_BLOCKS = 20
"""More would be shorter than they need be: noise of orientations is a rate that swings back, and
stretches too short to see it do so are overrated."""
SIGMAS = 2.8
"""Where the tails are made equal."""
_LEAST_FREEDOM = 2.0
"""Below, a variance estimated from so few has no mean."""
_TINY = 1e-12


class Columns(NamedTuple):
    """A weighted linear least-squares problem in its last iteration."""

    jacobian: Floats
    """Columns of rotation, bias and, last, the lag: shape (n, 3, 7)."""
    residual: Floats
    """Shape (n, 3)."""
    weight: Floats
    """Shape (n,)."""
    give: Floats
    """``-d log(weight) / d log |residual|``, shape (n,): 0 where the weight stays 1, 1 where Huber
    clips. A clipped residual no longer holds the lag along itself, only across."""


def lag_sigma(columns: Columns, t_s: Floats, memory_s: float) -> float:
    """Return the standard deviation of the lag, s; infinite where too little carries it.

    Parameters
    ----------
    columns : Columns
        At the solution.
    t_s : ndarray, shape (n,)
        Instants of the rows, rising, s.
    memory_s : float
        How long the filter makes residuals remember, s.
    """
    normal, gradient = _curvature(columns)
    whole = normal.sum(axis=0)
    whole[np.arange(3), np.arange(3)] += RIDGE * max(np.trace(whole[:3, :3]), _TINY)
    share = np.append(-np.linalg.solve(whole[:6, :6], whole[:6, 6]), 1.0)
    own = columns.jacobian @ share
    information = np.einsum("i,nij,j->n", share, normal, share)
    if information.sum() <= _TINY:
        return float("inf")
    block = np.floor((t_s - t_s[0]) / memory_s).astype(np.int64)
    period, memory = float(np.median(np.diff(t_s))), memory_s
    while np.unique(block).size > MOST_BLOCKS:
        block, memory = block // 2, 2.0 * memory
    score = columns.weight * np.sum(own * columns.residual, axis=1)
    free = _newey_west(score, max(1, round(memory / period)))
    table = np.concatenate((normal.reshape(-1, 49), gradient, information[:, None]), axis=1)
    return _widest(table, block, whole, free / information.sum() ** 2)


def _curvature(columns: Columns) -> tuple[Floats, Floats]:
    """Return each row's share of the normal matrix, (n, 7, 7), and of the gradient, (n, 7)."""
    jacobian, residual, weight, give = columns
    weighted = jacobian * weight[:, None, None]
    gradient = np.einsum("nij,ni->nj", weighted, residual)
    along = gradient / np.maximum(weight * np.linalg.norm(residual, axis=1), _TINY)[:, None]
    normal = np.einsum("nij,nik->njk", weighted, jacobian)
    return normal - np.einsum("n,nj,nk->njk", weight * give, along, along), gradient


def _widest(table: Floats, block: NDArray[np.int64], whole: Floats, free: float) -> float:
    """Return the largest standard deviation of all scales; `free` is that of no scale, squared."""
    variances: list[float] = []
    while True:
        first = np.flatnonzero(np.diff(block, prepend=-1))
        if variances and first.size < LEAST_BLOCKS:
            return float(np.sqrt(max(variances)))
        table, block = np.add.reduceat(table, first, axis=0), block[first] // 2
        freedom = float(table[:, -1].sum() ** 2 / np.sum(table[:, -1] ** 2)) - 1.0
        if freedom > _LEAST_FREEDOM:
            variance = _jackknife(table, whole)
            variances.append(variance if variances else max(variance, free) * _rarity(freedom) ** 2)
        elif not variances:
            return float("inf")


def _rarity(freedom: float) -> float:
    """Return Student's quantile that is as rare as `SIGMAS` of a normal one, over `SIGMAS`.

    Wallace's approximation (1959), good to a percent from three degrees of freedom on.
    """
    normal = SIGMAS * (8.0 * freedom + 3.0) / (8.0 * freedom + 1.0)
    return float(np.sqrt(freedom * np.expm1(normal**2 / freedom))) / SIGMAS


def _newey_west(score: Floats, lags: int) -> float:
    """Return the variance of the sum of `score`, correlated over so many samples."""
    variance = float(score @ score)
    for lag in range(1, min(lags, len(score) - 1) + 1):
        variance += 2.0 * (1.0 - lag / (lags + 1)) * float(score[lag:] @ score[:-lag])
    return max(variance, 0.0)


def _jackknife(table: Floats, whole: Floats) -> float:
    """Return the variance of the lag from what it would be without each block.

    One Gauss-Newton step from the solution, weights as they are.
    """
    rest = whole - table[:, :49].reshape(-1, 7, 7)
    pull = table[:, 49:56]
    moves = np.linalg.solve(rest, (pull - pull.sum(axis=0))[:, :, None])[:, 6, 0]
    n = len(table)
    return float((n - 1) / n * np.sum((moves - moves.mean()) ** 2))
