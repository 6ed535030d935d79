r"""How far a fitted lag may be off: a standard deviation that trusts nothing about the residuals.

Law: pure; judges a finished fit, changes nothing. Residuals of low-passed rates are correlated
over the filter's memory, and where the two bodies or the two systems disagree (skin, lens, gyro
scale) over whole movements. So the variance is taken at several scales and the largest one counts:

* the delete-a-block jackknife (Tukey; Künsch 1989): the lag without each stretch of the window,
  with at most 32 stretches, none shorter than the filter's memory, and with half as many
  again and again while five remain. It needs no model of the residuals, and a stretch that
  everything rests on betrays itself;
* Newey and West (1987), residuals correlated over the shortest of these stretches.

Each is widened by :math:`\nu/(\nu-2)`, the variance of Student's t, where :math:`\nu + 1 =
(\sum h)^2/\sum h^2` counts the stretches that carry the information h about the lag: one tap in a
window of rest leaves none, and the answer is infinite.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jointfit_daemon.timing.rates import Floats

RIDGE = 1e-9
"""Relative, on the rotation: motion about one axis leaves it open about that axis."""
LEAST_BLOCKS = 5
MOST_BLOCKS = 32
"""More would be shorter than they need be: noise of orientations is a rate that swings back, and
stretches too short to see it do so are overrated."""
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
    weighted = columns.jacobian * columns.weight[:, None, None]
    normal = np.einsum("nij,nik->njk", weighted, columns.jacobian)
    gradient = np.einsum("nij,ni->nj", weighted, columns.residual)
    whole = normal.sum(axis=0)
    whole[np.arange(3), np.arange(3)] += RIDGE * max(np.trace(whole[:3, :3]), _TINY)
    share = np.linalg.solve(whole[:6, :6], whole[:6, 6])
    own = columns.jacobian[:, :, 6] - columns.jacobian[:, :, :6] @ share
    information = columns.weight * np.sum(own**2, axis=1)
    if information.sum() <= _TINY:
        return float("inf")
    block = np.floor((t_s - t_s[0]) / memory_s).astype(np.int64)
    while np.unique(block).size > MOST_BLOCKS:
        block, memory_s = block // 2, 2.0 * memory_s
    score = columns.weight * np.sum(own * columns.residual, axis=1)
    period = float(np.median(np.diff(t_s)))
    blind = _newey_west(score, max(1, round(memory_s / period))) / information.sum() ** 2
    variances: list[float] = []
    table = np.concatenate((normal.reshape(-1, 49), gradient, information[:, None]), axis=1)
    while True:
        first = np.flatnonzero(np.diff(block, prepend=-1))
        if variances and first.size < LEAST_BLOCKS:
            return float(np.sqrt(max(variances)))
        table, block = np.add.reduceat(table, first, axis=0), block[first] // 2
        freedom = float(table[:, -1].sum() ** 2 / np.sum(table[:, -1] ** 2)) - 1.0
        if freedom > _LEAST_FREEDOM:
            variance = max(blind, _jackknife(table, whole))
            variances.append(variance * freedom / (freedom - _LEAST_FREEDOM))
            blind = 0.0  # its scale was the first
        elif not variances:
            return float("inf")


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
