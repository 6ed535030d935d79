"""Fit of the claimed variance against distance from the training range and disagreement."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.limb_model import FARTHEST, WITHIN, LeverageVariance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array


FAR = 1.5
"""Leverage ratio of a prior observation of the variance: training contains few frames far
outside."""
FAR_FACTOR = 3.0
"""Error of the prior observation relative to the RMS error."""
FAR_DISAGREEMENT = 2.0
"""Disagreement of the prior observation relative to the mean of all frames."""
FAR_SHARE = 0.1
"""Weight of the prior observation relative to all frames."""

LEAST = 0.15
"""Lower bound of a and b as a share of the mean square error."""

LEAST_DISAGREEMENT = 1.0
"""Lower bound of g. If the errors of both experts have the correlation c, the variance of their
mean is (1 + c) / (4 (1 - c)) of the mean squared difference: 1 for c = 0.6."""

PASSES = 5
"""Iterations of the gamma regression."""

SMALLEST_VARIANCE = 1e-8
"""Lower bound of the mean square error, rad²."""

HULL_PENALTY = 1e-2
"""Ridge penalty of the leverage matrix."""

SMALLEST_LEVERAGE = 1e-12
"""Lower bound of the leverage quantile: a static training movement has no leverage."""


def hull(smooth: Array) -> Array:
    """Return the matrix of leverages n s^T (S^T S + n p I)^-1 s of scaled smooth terms."""
    n, p = smooth.shape
    scales = np.sqrt(np.mean(smooth**2, axis=0)) + 1e-3
    g = smooth / scales
    inverse = n * np.linalg.inv(g.T @ g + n * HULL_PENALTY * np.eye(p))
    found: Array = 0.5 * (inverse + inverse.T) / np.outer(scales, scales)
    return found


def measure_spread(distances: Array, disagreements: Array, residuals: Array) -> LeverageVariance:
    """Fit the variance as a function of leverage ratio and disagreement over held-out frames.

    A prior observation (`FAR`, `FAR_FACTOR`) represents movements absent from the training.

    Parameters
    ----------
    distances : ndarray, shape (n,)
        Leverage ratio of each frame relative to the other groups.
    disagreements : ndarray, shape (n,)
        Mean squared difference of the corrections of both experts over the axes, rad².
    residuals : ndarray, shape (n, 3)
        Residual of each frame with its group held out, rad.
    """
    lines = [_line(distances, disagreements, square) for square in (residuals**2).T]
    (ax, bx, gx), (ay, by, gy), (az, bz, gz) = lines
    return LeverageVariance((ax, ay, az), (bx, by, bz), (gx, gy, gz))


def ratios(smooth: Array, groups: Sequence[NDArray[np.bool_]]) -> Array:
    """Return the leverage ratio of each frame relative to all other groups, shape (n,).

    Parameters
    ----------
    smooth : ndarray, shape (n, s)
        Smooth terms of all training frames.
    groups : sequence of ndarray of bool, shape (n,)
        Held-out masks of one grouping.
    """
    found = np.empty(len(smooth))
    for held in groups:
        matrix = hull(smooth[~held])
        h = np.einsum("ij,jk,ik->i", smooth, matrix, smooth)
        found[held] = h[held] / max(float(np.quantile(h[~held], 0.995)), SMALLEST_LEVERAGE)
    return np.minimum(found, FARTHEST)


def _line(distances: Array, disagreements: Array, squares: Array) -> tuple[float, float, float]:
    """Return a, b, g of E(square) = a + b max(r - 1/2, 0) + g D by gamma regression."""
    n = len(distances)
    typical = float(np.mean(squares)) + SMALLEST_VARIANCE
    far = (1.0, FAR - WITHIN, FAR_DISAGREEMENT * float(np.mean(disagreements)))
    beyond = np.maximum(distances - WITHIN, 0.0)
    design = np.vstack([np.stack([np.ones(n), beyond, disagreements], axis=1), far])
    squares = np.append(squares, FAR_FACTOR**2 * typical)
    shares = np.append(np.full(n, 1.0 / n), FAR_SHARE)
    from scipy.optimize import nnls  # noqa: PLC0415 - only fits need it, not the running daemon

    # Weights are the inverse of the current variance.
    least = np.array([LEAST * typical, LEAST * typical, LEAST_DISAGREEMENT])
    line = np.array([typical, 0.0, 0.0])
    for _ in range(PASSES):
        scale = np.sqrt(shares) / (design @ line)
        line = np.maximum(nnls(design * scale[:, None], squares * scale)[0], least)
    a, b, g = line.tolist()
    return a, b, g
