"""Fit of the variance of a correction as a function of the distance from the training range."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.limb_model import FARTHEST, WITHIN, LeverageVariance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array


FAR = 1.5
"""Leverage ratio of one assumed error, which is added to the errors of the held-out frames. The
assumption is needed, because training contains few frames far outside the training range.
"""
FAR_FACTOR = 3.0
"""Ratio of the assumed error to the RMS error of the held-out frames."""
FAR_SHARE = 0.3
"""Ratio of the weight of the assumed error to the sum of the weights of all frames."""

LEAST = 0.15
"""Lower bound of the coefficients a and b of `LeverageVariance`, as a fraction of the mean square
error.
"""

PASSES = 5
"""Number of iterations of the gamma regression."""

SMALLEST_VARIANCE = 1e-8
"""Lower bound of the mean square error, rad²."""

HULL_PENALTY = 1e-2
"""Ridge penalty of the leverage matrix."""

SMALLEST_LEVERAGE = 1e-12
"""Lower bound of the leverage quantile, for a training movement without motion."""


def hull(smooth: Array, weights: Array) -> Array:
    """Return the matrix H, with which ``s @ H @ s`` is the leverage of a frame.

    In scaled smooth terms the leverage is m s^T (S^T W S + m c I)^-1 s. S contains the smooth terms
    s of all training frames, the diagonal matrix W their weights with the sum m, and c is
    `HULL_PENALTY`.
    """
    total, p = np.sum(weights), smooth.shape[1]
    scales = np.sqrt(np.mean(smooth**2, axis=0)) + 1e-3
    g = smooth / scales
    gram = (g * weights[:, None]).T @ g
    inverse = total * np.linalg.inv(gram + total * HULL_PENALTY * np.eye(p))
    found: Array = 0.5 * (inverse + inverse.T) / np.outer(scales, scales)
    return found


def measure_spread(
    ratios_of: Sequence[Array], residuals: Sequence[Array], weights: Array
) -> LeverageVariance:
    """Fit the variance as a function of the leverage ratio over all held-out frames.

    Every grouping contributes to the fit. Blocks of a trial are close to the rest of the trial;
    whole trials are far from other trials. An assumed error (`FAR`, `FAR_FACTOR`) represents
    movements that no trial contains.

    Parameters
    ----------
    ratios_of : sequence of ndarray, shape (n,)
        Leverage ratio of each frame relative to the other groups, for each grouping.
    residuals : sequence of ndarray, shape (n, 3)
        Residual of each frame with its group held out, for each grouping, rad.
    weights : ndarray, shape (n,)
        Weights of the frames.
    """
    distances = np.concatenate(ratios_of)
    squares = np.concatenate([each**2 for each in residuals])
    shares = np.tile(weights, len(ratios_of))
    shares = shares / np.sum(shares)
    found = [_line(distances, square, shares) for square in squares.T]
    (ax, bx), (ay, by), (az, bz) = found
    return LeverageVariance((ax, ay, az), (bx, by, bz))


def ratios(smooth: Array, groups: Sequence[NDArray[np.bool_]], weights: Array) -> Array:
    """Return the leverage ratio of each frame relative to all other groups, shape (n,).

    Parameters
    ----------
    smooth : ndarray, shape (n, s)
        Smooth terms of all training frames.
    groups : sequence of ndarray of bool, shape (n,)
        Held-out masks of one grouping.
    weights : ndarray, shape (n,)
        Weights of the frames.
    """
    found = np.empty(len(smooth))
    for held in groups:
        matrix = hull(smooth[~held], weights[~held])
        h = np.einsum("ij,jk,ik->i", smooth, matrix, smooth)
        found[held] = h[held] / max(float(np.quantile(h[~held], 0.995)), SMALLEST_LEVERAGE)
    return np.minimum(found, FARTHEST)


def _line(distances: Array, squares: Array, shares: Array) -> tuple[float, float]:
    """Return a, b of E(square) = a + b max(r - 1/2, 0), fitted by iterated gamma regression."""
    typical = float(shares @ squares) + SMALLEST_VARIANCE
    distances = np.append(distances, FAR)
    squares = np.append(squares, FAR_FACTOR**2 * typical)
    shares = np.append(shares, FAR_SHARE)

    beyond = np.maximum(distances - WITHIN, 0.0)
    design = np.stack([np.ones_like(beyond), beyond], axis=1)
    from scipy.optimize import nnls  # noqa: PLC0415 - only fits need it, not the running daemon

    # The weights are the inverse of the current variance.
    line = np.array([typical, 0.0])
    for _ in range(PASSES):
        scale = np.sqrt(shares) / (design @ line)
        line = nnls(design * scale[:, None], squares * scale)[0]
        line = np.maximum(line, LEAST * typical)
    return float(line[0]), float(line[1])
