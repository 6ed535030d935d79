r"""Ridge regression on smooth terms and bumps (kernels); stacking combines the penalties.

.. math:: c_{jp} = \arg\min \sum_i w_i h_{ij} (\rho_{ij} - c_{jp}^T g_i)^2
          + \lambda_p n (|c_{smooth}|^2 + r_p |c_{bumps}|^2), \qquad c_j = \sum_p a_{jp} c_{jp}

.. math:: a_j = \arg\min_{a \ge 0,\ \sum a \le 1} \sum_i w_i
          \bigl(\rho_{ij} - \sum_p a_p\, \hat\rho_{ijp}\bigr)^2

for every axis j. The index p counts the pairs of a penalty :math:`\lambda` and a ratio r, n is the
number of frames, w are the weights of the frames with mean 1, h the Huber weights of the final fit,
g the regressors, :math:`\rho` the target corrections in rad, and :math:`\hat\rho` their
predictions in held-out frames (stacking: Breiman 1996). Regressors are not centered, because
the regression must have no intercept. The shares a may sum to less than 1. The part of the
correction that does not generalize to held-out frames is then omitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._robust_weights import huber_weights, robust_scale

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

    Masks = Sequence[NDArray[np.bool_]]

PENALTIES = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Ridge penalties. The model is the weighted sum of one fit for each penalty and ratio."""
RATIOS = (1.0, 0.1, 10.0)
"""Ratios of the penalty of bumps to the penalty of smooth terms."""
PASSES = 3
"""Number of reweighting iterations."""
SMALLEST_SCALE = 1e-3
"""Constant that is added to the RMS of each regressor, rad, so that a nearly constant regressor is
not amplified.
"""
_JITTER = 1e-6
"""Constant that is added to the diagonal of a kernel matrix for a stable Cholesky decomposition."""
_HEAVY = 1e3
"""Relative weight of the row that fixes the sum of the shares."""
_SMALLEST_SHARE = 1e-3
"""Share below which the fit of a penalty is omitted from the final sum."""
_BUMPS_COUNT_AS = 5.0
"""Sum of the mean squares of all bumps after scaling. The mean square of a smooth term is 1."""


@dataclass(frozen=True, slots=True)
class Basis:
    """Scaled regressors of the training frames, and the transformation back to raw regressors."""

    g: Array
    """Scaled regressors, smooth terms before whitened bumps, shape (n, p) for p regressors."""
    smooth: int
    """Number of smooth terms."""
    back: Array
    """Matrix from coefficients c to coefficients of raw regressors, ``back @ c``, shape (p, p)."""

    @staticmethod
    def of(smooth: Array, raw_bumps: Array, at_centers: Array) -> Basis:
        """Scale smooth terms and whiten bumps.

        Parameters
        ----------
        smooth : ndarray, shape (n, s)
            Smooth terms of the training frames.
        raw_bumps : ndarray, shape (n, m)
            Bumps of the training frames.
        at_centers : ndarray, shape (m, m)
            Kernel matrix: bumps evaluated at the centers.
        """
        s, m = smooth.shape[1], raw_bumps.shape[1]
        back = np.zeros((s + m, s + m))
        scales = np.sqrt(np.mean(smooth**2, axis=0)) + SMALLEST_SCALE
        back[:s, :s] = np.diag(1.0 / scales)
        g = smooth / scales

        # Whiten the bumps with the Cholesky factor of the kernel matrix.
        if m:
            root = np.linalg.cholesky(at_centers + _JITTER * np.eye(m))
            white = np.linalg.solve(root, raw_bumps.T).T
            scale = np.sqrt(np.mean(np.sum(white**2, axis=1)) / _BUMPS_COUNT_AS) + SMALLEST_SCALE
            back[s:, s:] = np.linalg.inv(root).T / scale
            g = np.concatenate([g, white / scale], axis=1)
        return Basis(g, s, back)

    def shape(self, ratio: float) -> Array:
        """Return the relative penalty of each regressor."""
        count = self.g.shape[1]
        return np.concatenate([np.ones(self.smooth), np.full(count - self.smooth, ratio)])


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Shares of the penalties for one grouping, and the residuals of held-out frames."""

    shares: Array
    """Share a by axis, ratio and penalty, shape (3, ratios, penalties)."""
    residuals: Array
    """Difference between rho and its prediction on held-out frames, in order of time, rad, shape
    (n, 3).
    """


def choose(basis: Basis, rho: Array, groups: Masks, weights: Array) -> HeldOut:
    """Hold out each group in turn, and combine the predictions of all penalties for each axis.

    `rho` contains the target corrections, rad, shape (n, 3), `groups` the mask of the frames of
    each group, and `weights` the weight of each frame, shape (n,). One eigendecomposition per group
    and ratio is sufficient for all penalties.
    """
    predicted = np.empty((len(RATIOS), len(PENALTIES), *rho.shape))
    for held in groups:
        kept = basis.g[~held]
        weighted = kept * weights[~held, None]
        gram, moment = weighted.T @ kept, weighted.T @ rho[~held]
        total = np.sum(weights[~held])

        for i, ratio in enumerate(RATIOS):
            root = np.sqrt(basis.shape(ratio))
            values, vectors = np.linalg.eigh(gram / np.outer(root, root))
            turned = vectors.T @ (moment / root[:, None])
            seen = (basis.g[held] / root) @ vectors
            for j, penalty in enumerate(PENALTIES):
                predicted[i, j, held] = seen @ (turned / (values + penalty * total)[:, None])

    # The shares of the penalties are computed for each axis.
    shares, residuals = [], np.empty_like(rho)
    roots = np.sqrt(weights)
    for axis in range(rho.shape[1]):
        A = predicted[:, :, :, axis].reshape(-1, len(rho)).T
        found = stacking_weights(A * roots[:, None], rho[:, axis] * roots)
        residuals[:, axis] = rho[:, axis] - A @ found
        shares.append(found.reshape(len(RATIOS), len(PENALTIES)))
    return HeldOut(np.array(shares), residuals)


def stacking_weights(predictions: Array, y: Array) -> Array:
    """Return shares a >= 0, sum <= 1, that minimize ``|y - predictions @ a|``.

    Parameters
    ----------
    predictions : ndarray, shape (n, p)
        Predictions of the n targets by p fits.
    y : ndarray, shape (n,)
        Targets.
    """
    from scipy.optimize import nnls  # noqa: PLC0415 - only fits need it, not the running daemon

    gram = predictions.T @ predictions
    count = len(gram)
    size = np.trace(gram) / count + 1e-12
    # A column of zeros is the slack variable. A row with a large weight fixes the sum at 1.
    whole = np.pad(gram, (0, 1)) + _HEAVY * size + _JITTER * size * np.eye(count + 1)
    moment = np.append(predictions.T @ y, 0.0) + _HEAVY * size
    root = np.linalg.cholesky(whole)
    found: Array = nnls(root.T, np.linalg.solve(root, moment), maxiter=100 * count)[0]
    return found[:count]


def fit(basis: Basis, rho: Array, shares: Array, weights: Array) -> Array:
    """Return coefficients of raw regressors, shape (p, 3), from ridge fits combined by `shares`."""
    columns = [_robust(basis, rho[:, axis], share, weights) for axis, share in enumerate(shares)]
    found: Array = basis.back @ np.stack(columns, axis=1)
    return found


def _robust(basis: Basis, y: Array, shares: Array, of_frames: Array) -> Array:
    """Return the coefficients of one axis, with Huber weights of the combined residuals."""
    g, n = basis.g, len(y)
    taken = [
        (shares[i, j], n * PENALTIES[j] * basis.shape(RATIOS[i]))
        for i, j in zip(*np.nonzero(shares > _SMALLEST_SHARE), strict=True)
    ]

    weights: Array = of_frames
    c: Array = np.zeros(g.shape[1])
    for _ in range(PASSES):
        weighted = g * weights[:, None]
        gram, moment = weighted.T @ g, weighted.T @ y
        c = np.zeros_like(c)
        for share, penalty in taken:
            c += share * np.linalg.solve(gram + np.diag(penalty), moment)
        sizes = np.abs(y - g @ c)
        weights = of_frames * huber_weights(sizes, robust_scale(sizes))
    return c
