"""Fit of the claimed variance against the distance from the training range."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.limb_model import FARTHEST, WITHIN, Spread

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array


FAR, FAR_FACTOR, FAR_SHARE = 1.5, 3.0, 0.1
"""Beforehand, at this ratio errors are taken to be so many times larger, and this counts as much as
so many parts of the trials: training shows little of what lies far outside of it."""

LEAST = 0.15
"""Neither a nor b is less than so many parts of the mean square."""

PASSES = 5

SMALLEST_VARIANCE = 1e-8

HULL_PENALTY = 1e-2

SMALLEST_LEVERAGE = 1e-12
"""Who only stood still and straight has none; whatever moves lies far outside of that."""


def hull(smooth: Array) -> Array:
    """Return the matrix of leverages n s^T (S^T S + n p I)^-1 s of scaled smooth terms."""
    n, p = smooth.shape
    scales = np.sqrt(np.mean(smooth**2, axis=0)) + 1e-3
    g = smooth / scales
    inverse = n * np.linalg.inv(g.T @ g + n * HULL_PENALTY * np.eye(p))
    found: Array = 0.5 * (inverse + inverse.T) / np.outer(scales, scales)
    return found


def measure_spread(ratios_of: Sequence[Array], residuals: Sequence[Array]) -> Spread:
    """Fit variance against distance over all frames that some fit has not seen.

    Every way of leaving frames out adds its own: blocks of a trial lie near the rest of it, whole
    trials far. What is taken of a movement that nobody made is `FAR_FACTOR`.

    Parameters
    ----------
    ratios_of : sequence of ndarray, shape (n,)
        By way of leaving out: how far each frame lies outside all groups but its own.
    residuals : sequence of ndarray, shape (n, 3)
        By way: what is left over of each frame when its group is left out, rad.
    """
    distances = np.concatenate(ratios_of)
    squares = np.concatenate([each**2 for each in residuals])
    shares = np.full(len(distances), 1.0 / len(distances))
    found = [_line(distances, square, shares) for square in squares.T]
    (ax, bx), (ay, by), (az, bz) = found
    return Spread((ax, ay, az), (bx, by, bz))


def ratios(smooth: Array, groups: Sequence[NDArray[np.bool_]]) -> Array:
    """Return how far each frame lies outside all groups but its own, shape (n,).

    Parameters
    ----------
    smooth : ndarray, shape (n, s)
        Smooth terms of all frames of training.
    groups : sequence of ndarray of bool, shape (n,)
        One way of leaving out.
    """
    found = np.empty(len(smooth))
    for held in groups:
        matrix = hull(smooth[~held])
        h = np.einsum("ij,jk,ik->i", smooth, matrix, smooth)
        found[held] = h[held] / max(float(np.quantile(h[~held], 0.995)), SMALLEST_LEVERAGE)
    return np.minimum(found, FARTHEST)


def _line(distances: Array, squares: Array, shares: Array) -> tuple[float, float]:
    """Return a, b of E(square) = a + b max(r - 1/2, 0): gamma regression, five passes."""
    typical = float(np.mean(squares)) + SMALLEST_VARIANCE
    distances = np.append(distances, FAR)
    squares = np.append(squares, FAR_FACTOR**2 * typical)
    shares = np.append(shares, FAR_SHARE)
    beyond = np.maximum(distances - WITHIN, 0.0)
    design = np.stack([np.ones_like(beyond), beyond], axis=1)
    from scipy.optimize import nnls  # noqa: PLC0415 - fits need it, a running daemon does not

    line = np.array([typical, 0.0])
    for _ in range(PASSES):
        scale = np.sqrt(shares) / (design @ line)
        line = nnls(design * scale[:, None], squares * scale)[0]
        line = np.maximum(line, LEAST * typical)
    return float(line[0]), float(line[1])
