r"""Ridge regression through the origin with Huber weights.

.. math:: H = \sum_i w_i h_i g_i g_i^T + \lambda n I, \qquad
          C = H^{-1} \sum_i w_i h_i g_i \rho_i^T

where :math:`g_i` are the scaled regressors of frame i, :math:`\rho_i` its targets, w the weights of
the frames with mean 1, h the Huber weights, n the number of frames, :math:`\lambda` the penalty,
and C the coefficients.

Regressors are scaled but not centered, because the regression must have no intercept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._robust_weights import huber_weights, robust_scale

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

PASSES = 5
"""Number of reweighting iterations."""
_SMALLEST_SCALE = 1e-9


@dataclass(frozen=True, slots=True)
class Ridge:
    """Result of a fit, in units of the raw regressors."""

    coefficients: Array
    """Coefficients of k targets per unit of each regressor, shape (p, k)."""
    leverage: Array
    """Matrix whose quadratic form ``phi @ leverage @ phi`` is the leverage n g^T H^-1 g of a row,
    shape (p, p).
    """
    scales: Array
    """RMS of each regressor in training plus `smallest_scale`, shape (p,). The scaled regressors
    are g = phi / scales.
    """

    def leverages(self, phi: Array) -> Array:
        """Return the leverage of each row, shape (n,)."""
        found: Array = np.einsum("ij,jk,ik->i", phi, self.leverage, phi)
        return found


def fit_ridge(
    phi: Array,
    rho: Array,
    penalty: float,
    smallest_scale: float = _SMALLEST_SCALE,
    *,
    weights: Array | None = None,
) -> Ridge:
    """Fit rho (n, k) on phi (n, p), with five iterations of Huber weights of the residual norm.

    `penalty` is λ of the module's equation. `smallest_scale` is added to the RMS of each regressor,
    so that a nearly constant regressor is not amplified. `weights` are the weights w of the frames,
    shape (n,); by default all are 1.
    """
    n, p = phi.shape
    scales = np.sqrt(np.mean(phi**2, axis=0)) + smallest_scale
    g = phi / scales

    of_frames = np.ones(n) if weights is None else weights
    weights = of_frames
    H, C = np.eye(p), np.zeros((p, rho.shape[1]))
    for _ in range(PASSES):
        weighted = g * weights[:, None]
        H = weighted.T @ g + penalty * n * np.eye(p)
        C = np.linalg.solve(H, weighted.T @ rho)
        sizes = np.linalg.norm(rho - g @ C, axis=1)
        weights = of_frames * huber_weights(sizes, robust_scale(sizes))

    inverse = n * np.linalg.inv(H) / np.outer(scales, scales)
    return Ridge(C / scales[:, None], 0.5 * (inverse + inverse.T), scales)
