r"""Standard deviation of a fitted lag, without a model for the correlation of the residuals.

Residuals of low-pass filtered rates are correlated over the filter length. Errors of soft tissue,
lens or gyro scale correlate the residuals over whole movements. The variance is therefore estimated
in several ways, and the largest estimate is used:

* the delete-a-block jackknife (Tukey; Künsch 1989): the lag is computed without each block of the
window in turn. The window has at most 20 blocks, none shorter than the filter. The computation is
repeated with blocks of twice the length (a coarser scale) while at least five blocks remain. The
jackknife needs no model of the residuals. It detects a single block that determines the result;
* the estimator of Newey and West (1987), with residuals correlated over the shortest of these
blocks.

A variance from few blocks is uncertain itself. :math:`\nu + 1 = (\sum h)^2/\sum h^2` is the
effective number of blocks that carry the information h about the lag. The standard deviation of the
finest scale is multiplied by the ratio of the Student t quantile with :math:`\nu` degrees of
freedom to the normal quantile of equal probability. The other scales only detect long correlations,
and are not corrected. If the window contains a single short movement and otherwise rest, the result
is infinite.

If all samples with information about the lag have the same timestamp error, the residuals do not
show this error. Devices sample on ticks of an internal clock. The rounding error of the timestamps
is a sawtooth: the error drifts through one tick and jumps back. The mean error over time is part of
the lag, but a short passage of fast motion contains only a part of the sawtooth. If the phase of
the sawtooth is random, its contribution to the variance of the lag is

.. math:: \sigma_s^2 G, \quad G = \frac{6}{\pi^2} \sum_{k=1}^{3} \frac{|H(k/P)|^2}{k^2}, \quad
          H(f) = \frac{\sum h_j e^{2\pi i f t_j}}{\sum h_j},

where G is the power of the harmonics of a sawtooth of period P, weighted with the information h_j
of the sample at the instant t_j, and :math:`\sigma_s` is the standard deviation of the sawtooth.
The jackknife already contains the scatter of the sawtooth between blocks, :math:`\sigma_s^2 (1 - G)
\sum p_b^2`, where p_b is the fraction of the information in block b of the filter length. The
difference of the two variances is added. This difference is zero if the motion is uniform over the
window.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.timing.lag._angular_rates import Floats

RIDGE = 1e-9
"""Ridge (regularization) of the rotation, relative to its information. Motion about one axis does
not determine the rotation about that axis.
"""
LEAST_BLOCKS = 5
"""Least number of blocks."""
MOST_BLOCKS = 20
"""Largest number of blocks. Shorter blocks would overestimate the effect of orientation noise,
whose rate is anticorrelated over short times.
"""
SIGMAS = 2.8
"""Normal quantile whose tail probability the Student t quantile matches."""
STAMP_PERIODS_S = (1.95, 3.9)
"""Periods of the sawtooth error of the timestamps, s; the larger variance is used.

The period is the tick divided by the relative skew. The recordings of the benchmark experiment
``lag-all-trials`` (docs/accuracy/timing.md) have a tick of 0.5 ms and a skew of 257 ppm, hence a
period of 1.95 s. The second period belongs to half this skew. A slower sawtooth is nearly constant
in most windows, and is then part of their lag.
"""
_HARMONICS = np.arange(1, 4)
"""Numbers of the harmonics of the sawtooth that are used; they contain 83 % of its power."""
_LEAST_FREEDOM = 2.0
"""Degrees of freedom below which the variance of Student's t does not exist."""
_TINY = 1e-12


class LinearizedLag(NamedTuple):
    """Weighted linear least-squares problem of one iteration, with n rows of three axes."""

    jacobian: Floats
    """Derivatives with respect to rotation, bias and, in the last column, lag, shape (n, 3, 7)."""
    residual: Floats
    """Residuals, rad/s, shape (n, 3)."""
    weight: Floats
    """Huber weights, shape (n,)."""
    give: Floats
    """``-d log(weight) / d log |residual|``, shape (n,): 0 where the Huber weight is 1, and 1 where
    it is below 1. A residual with a weight below 1 constrains the lag only perpendicular to its own
    direction.
    """
    rate: Floats
    """Rate of the slower track, rad/s, shape (n, 3)."""
    t_s: Floats
    """Instants in ascending order, s, shape (n,)."""


def lag_sigma(solved: LinearizedLag, memory_s: float, stamp_sd_s: float = 0.0) -> float:
    """Return the standard deviation of the lag, s; infinite if too few rates determine the lag.

    Parameters
    ----------
    solved : LinearizedLag
        Linearization at the solution.
    memory_s : float
        Time over which the low-pass filter correlates residuals, s.
    stamp_sd_s : float
        Standard deviation of the slowly varying error of the timestamps, s.
    """
    normal, gradient = _curvature(solved)
    whole = normal.sum(axis=0)
    whole[np.arange(3), np.arange(3)] += RIDGE * max(np.trace(whole[:3, :3]), _TINY)
    share = np.append(-np.linalg.solve(whole[:6, :6], whole[:6, 6]), 1.0)
    own = solved.jacobian @ share
    information = (normal @ share) @ share
    if information.sum() <= _TINY:
        return float("inf")

    # At most `MOST_BLOCKS` blocks, none shorter than the filter.
    t_s = solved.t_s
    block = np.floor((t_s - t_s[0]) / memory_s).astype(np.int64)
    period, memory = float(np.median(np.diff(t_s))), memory_s
    while np.unique(block).size > MOST_BLOCKS:
        block, memory = block // 2, 2.0 * memory

    score = solved.weight * np.sum(own * solved.residual, axis=1)
    free = _newey_west(score, max(1, round(memory / period)))
    table = np.concatenate((normal.reshape(-1, 49), gradient, information[:, None]), axis=1)
    observed = _widest(table, block, whole, free / information.sum() ** 2)

    stamps = stamp_sd_s * _unobserved_sawtooth(t_s, information, memory_s)
    return float(np.hypot(observed, stamps))


def _unobserved_sawtooth(t_s: Floats, information: Floats, memory_s: float) -> float:
    """Return the standard deviation of the lag that a sawtooth error of the timestamps causes.

    The sawtooth has unit standard deviation. The scatter of the sawtooth between blocks is not
    included.
    """
    share = information / information.sum()
    cycles = np.multiply.outer(np.divide.outer(_HARMONICS, STAMP_PERIODS_S), t_s - t_s[0])
    waves = np.abs(np.exp(2j * np.pi * cycles) @ share)
    gain = 6.0 / np.pi**2 * float(np.sum((waves / _HARMONICS[:, None]) ** 2, axis=0).max())

    blocks = np.bincount(((t_s - t_s[0]) / memory_s).astype(np.int64), weights=share)
    return float(np.sqrt(max(gain - (1.0 - gain) * float(blocks @ blocks), 0.0)))


def _curvature(solved: LinearizedLag) -> tuple[Floats, Floats]:
    """Return the contribution of each row to the normal matrix, (n, 7, 7), and gradient, (n, 7)."""
    jacobian, residual, weight, give, *_ = solved
    weighted = jacobian * weight[:, None, None]
    gradient = np.einsum("nij,ni->nj", weighted, residual)
    along = gradient / np.maximum(weight * np.linalg.norm(residual, axis=1), _TINY)[:, None]
    normal = np.swapaxes(weighted, 1, 2) @ jacobian
    clipped = (weight * give)[:, None] * along
    return normal - clipped[:, :, None] * along[:, None, :], gradient


def _widest(table: Floats, block: NDArray[np.int64], whole: Floats, free: float) -> float:
    """Return the largest standard deviation over all scales; `free` is the Newey-West variance."""
    variances: list[float] = []
    while True:
        first = np.flatnonzero(np.diff(block, prepend=-1))
        if variances and first.size < LEAST_BLOCKS:
            return float(np.sqrt(max(variances)))
        table, block = np.add.reduceat(table, first, axis=0), block[first] // 2
        freedom = float(table[:, -1].sum() ** 2 / np.sum(table[:, -1] ** 2)) - 1.0
        if freedom > _LEAST_FREEDOM and variances:
            variances.append(_jackknife(table, whole))
        elif freedom > _LEAST_FREEDOM:
            # Student's quantile of the probability of `SIGMAS` by Wallace's approximation (1959),
            # accurate to 1 % from three degrees of freedom on.
            normal = SIGMAS * (8.0 * freedom + 3.0) / (8.0 * freedom + 1.0)
            student = float(np.sqrt(freedom * np.expm1(normal**2 / freedom)))
            variances.append(max(_jackknife(table, whole), free) * (student / SIGMAS) ** 2)
        elif not variances:
            return float("inf")


def _newey_west(score: Floats, lags: int) -> float:
    """Return the variance of the sum of `score`, with correlations over `lags` samples."""
    variance = float(score @ score)
    for lag in range(1, min(lags, len(score) - 1) + 1):
        variance += 2.0 * (1.0 - lag / (lags + 1)) * float(score[lag:] @ score[:-lag])
    return max(variance, 0.0)


def _jackknife(table: Floats, whole: Floats) -> float:
    """Return the jackknife variance of the lag.

    For each deleted block the lag is computed by one Gauss-Newton step from the solution, with
    fixed weights.
    """
    rest = whole - table[:, :49].reshape(-1, 7, 7)
    pull = table[:, 49:56]
    moves = np.linalg.solve(rest, (pull - pull.sum(axis=0))[:, :, None])[:, 6, 0]
    n = len(table)
    return float((n - 1) / n * np.sum((moves - moves.mean()) ** 2))
