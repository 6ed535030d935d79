"""Effect of the parent's marker noise on a point in the parent's plane coordinates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

_LEAST_SPREAD_M2 = 1e-12
"""Sum of squared distances from the mean, m², below which markers are at one position."""


def planar_noise(points: Array, parent: Array, noise: float) -> Array:
    r"""Return the covariance of points in a planar frame that is fitted to noisy markers.

    .. math:: Σ_x = σ^2 \left[ \left(1 + \tfrac1m\right) I
              + \frac{λ_⊥ λ_⊥^T}{\sum_j |d_j|^2} \right], \quad λ = x - \bar y,
              \quad d_j = y_j - \bar y

    to first order in the noise. y_j are the m parent markers with noise σ, and ȳ is their mean. λ
    is the lever arm of the point x, and λ_⊥ is λ rotated by 90°. For rotations about one axis,
    `spatial_noise` returns the same result.

    Parameters
    ----------
    points : ndarray, shape (..., 2)
        Points in the parent's coordinates, m.
    parent : ndarray, shape (m, 2)
        The parent's markers in its own coordinates, m.
    noise : float
        Standard deviation of every coordinate of every marker, m.

    Returns
    -------
    ndarray, shape (..., 2, 2)
        Covariance of each point, m².

    Raises
    ------
    ValueError
        The markers do not determine a frame: there are fewer than two, or all are at one position.
    """
    middle = parent.mean(axis=0)
    spread = float(((parent - middle) ** 2).sum())
    if len(parent) < 2 or spread < _LEAST_SPREAD_M2:
        raise ValueError("a frame in a plane needs two markers at different positions: move one")

    lever = np.asarray(points, dtype=np.float64) - middle
    across = np.stack((-lever[..., 1], lever[..., 0]), axis=-1)
    turned = across[..., :, None] * across[..., None, :] / spread
    return np.asarray(noise**2 * ((1.0 + 1.0 / len(parent)) * np.eye(2) + turned))
