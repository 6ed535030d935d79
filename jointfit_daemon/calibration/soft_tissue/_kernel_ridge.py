r"""Ridge regression on smooth terms and bumps, several penalties stacked by held-out groups.

.. math:: c_{jp} = \arg\min \sum_i w_{ij} (\rho_{ij} - c_{jp}^T g_i)^2
          + \lambda_p n (|c_{smooth}|^2 + r_p |c_{bumps}|^2), \qquad c_j = \sum_p a_{jp} c_{jp}

.. math:: a_j = \arg\min_{a \ge 0,\ \sum a \le 1} \sum_i
          \bigl(\rho_{ij} - \sum_p a_p\, \hat\rho_{ijp}\bigr)^2

for every axis j, with predictions of frames whose group was left out (stacking: Breiman 1996).
Law: nothing is centered, which would be an intercept by another name. Shares may sum to less than
one: what does not carry over to frames that the fit has not seen is left to the mean of the
sensors.
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
RATIOS = (1.0, 0.1, 10.0)
"""Penalty of bumps over that of smooth terms."""
PASSES = 3
SMALLEST_SCALE = 1e-3
"""A feature that hardly moved in training is not blown up, rad."""
_JITTER = 1e-6
_HEAVY = 1e3
_SMALLEST_SHARE = 1e-3
_BUMPS_COUNT_AS = 5.0
"""All bumps together are scaled as if they were so many features."""


@dataclass(frozen=True, slots=True)
class Basis:
    """Features of training, scaled, and the way back to coefficients of raw features."""

    g: Array
    """Shape (n, p): smooth terms, then bumps made independent of each other."""
    smooth: int
    """How many of them are smooth terms."""
    back: Array
    """Shape (p, p): coefficients of raw features are ``back @ c``."""

    @staticmethod
    def of(smooth: Array, raw_bumps: Array, at_centers: Array) -> Basis:
        """Scale and whiten.

        Parameters
        ----------
        smooth : ndarray, shape (n, s)
        raw_bumps : ndarray, shape (n, m)
        at_centers : ndarray, shape (m, m)
            Bumps at the centers themselves: the kernel matrix.
        """
        s, m = smooth.shape[1], raw_bumps.shape[1]
        back = np.zeros((s + m, s + m))
        scales = np.sqrt(np.mean(smooth**2, axis=0)) + SMALLEST_SCALE
        back[:s, :s] = np.diag(1.0 / scales)
        g = smooth / scales
        if m:
            root = np.linalg.cholesky(at_centers + _JITTER * np.eye(m))
            white = np.linalg.solve(root, raw_bumps.T).T
            scale = np.sqrt(np.mean(np.sum(white**2, axis=1)) / _BUMPS_COUNT_AS) + SMALLEST_SCALE
            back[s:, s:] = np.linalg.inv(root).T / scale
            g = np.concatenate([g, white / scale], axis=1)
        return Basis(g, s, back)

    def shape(self, ratio: float) -> Array:
        """Return the penalty's shape, one number a feature."""
        count = self.g.shape[1]
        return np.concatenate([np.ones(self.smooth), np.full(count - self.smooth, ratio)])


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Shares of penalties by one way of grouping frames, and what was left over."""

    shares: Array
    """a, by axis, ratio and penalty, shape (3, ratios, penalties)."""
    residuals: Array
    """rho minus prediction of held-out frames in order of time, rad, shape (n, 3)."""


def choose(basis: Basis, rho: Array, groups: Masks) -> HeldOut:
    """Leave out each group in turn; stack the predictions of all penalties, axis by axis.

    One eigendecomposition a group and ratio serves all penalties.
    """
    said = np.empty((len(RATIOS), len(PENALTIES), *rho.shape))
    for held in groups:
        kept = basis.g[~held]
        gram, moment = kept.T @ kept, kept.T @ rho[~held]
        for i, ratio in enumerate(RATIOS):
            root = np.sqrt(basis.shape(ratio))
            values, vectors = np.linalg.eigh(gram / np.outer(root, root))
            turned = vectors.T @ (moment / root[:, None])
            seen = (basis.g[held] / root) @ vectors
            for j, penalty in enumerate(PENALTIES):
                said[i, j, held] = seen @ (turned / (values + penalty * len(kept))[:, None])
    shares, residuals = [], np.empty_like(rho)
    for axis in range(rho.shape[1]):
        A = said[:, :, :, axis].reshape(-1, len(rho)).T
        found = stacked(A, rho[:, axis])
        residuals[:, axis] = rho[:, axis] - A @ found
        shares.append(found.reshape(len(RATIOS), len(PENALTIES)))
    return HeldOut(np.array(shares), residuals)


def stacked(predictions: Array, y: Array) -> Array:
    """Return shares a >= 0, sum <= 1, of the smallest squared error ``|y - predictions @ a|``.

    Parameters
    ----------
    predictions : ndarray, shape (n, p)
    y : ndarray, shape (n,)
    """
    from scipy.optimize import nnls  # noqa: PLC0415 - fits need it, a running daemon does not

    gram = predictions.T @ predictions
    count = len(gram)
    size = np.trace(gram) / count + 1e-12
    # one more column, of zeros, takes what is missing to one; a heavy row holds the sum there
    whole = np.pad(gram, (0, 1)) + _HEAVY * size + _JITTER * size * np.eye(count + 1)
    moment = np.append(predictions.T @ y, 0.0) + _HEAVY * size
    root = np.linalg.cholesky(whole)
    found: Array = nnls(root.T, np.linalg.solve(root, moment), maxiter=100 * count)[0]
    return found[:count]


def fit(basis: Basis, rho: Array, shares: Array) -> Array:
    """Return coefficients of raw features, shape (p, 3): ridge fits by their `shares`."""
    columns = [_robust(basis, rho[:, axis], share) for axis, share in enumerate(shares)]
    found: Array = basis.back @ np.stack(columns, axis=1)
    return found


def _robust(basis: Basis, y: Array, shares: Array) -> Array:
    """Return the coefficients of one axis; Huber weights by what the stack leaves over."""
    g, n = basis.g, len(y)
    taken = [
        (shares[i, j], n * PENALTIES[j] * basis.shape(RATIOS[i]))
        for i, j in zip(*np.nonzero(shares > _SMALLEST_SHARE), strict=True)
    ]
    weights: Array = np.ones(n)
    c: Array = np.zeros(g.shape[1])
    for _ in range(PASSES):
        weighted = g * weights[:, None]
        gram, moment = weighted.T @ g, weighted.T @ y
        c = np.zeros_like(c)
        for share, penalty in taken:
            c += share * np.linalg.solve(gram + np.diag(penalty), moment)
        sizes = np.abs(y - g @ c)
        weights = huber_weights(sizes, robust_scale(sizes))
    return c
