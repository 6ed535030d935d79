r"""Ridge regression on smooth terms and bumps, one penalty an axis, chosen by held-out groups.

.. math:: c_j = \arg\min \sum_i w_{ij} (\rho_{ij} - c_j^T g_i)^2
          + \lambda_j n (|c_{j,smooth}|^2 + r_j |c_{j,bumps}|^2)

Law: nothing is centered, which would be an intercept by another name. Each axis j has its own
penalty, up to one at which the correction is nil: what does not carry over to frames that the fit
has not seen is left to the mean of the sensors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.robust import huber_weights, robust_scale

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Masks = Sequence[NDArray[np.bool_]]

PENALTIES = (1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0, 1e4)
RATIOS = (1.0, 0.1, 10.0)
"""Penalty of bumps over that of smooth terms."""
PASSES = 3
SMALLEST_SCALE = 1e-3
"""A feature that hardly moved in training is not blown up, rad."""
_JITTER = 1e-6
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
    """The choice of penalties by one way of grouping frames, and what was left over."""

    choice: tuple[tuple[float, float], ...]
    """Ratio and penalty, one pair an axis."""
    residuals: Array
    """rho minus prediction of held-out frames in order of time, rad, shape (n, 3)."""


def choose(basis: Basis, rho: Array, groups: Masks) -> HeldOut:
    """Leave out each group in turn; per axis take the penalty with the smallest squared error.

    One eigendecomposition a group and ratio serves all penalties.
    """
    left = np.empty((len(RATIOS), len(PENALTIES), *rho.shape))
    for held in groups:
        kept = basis.g[~held]
        gram, moment = kept.T @ kept, kept.T @ rho[~held]
        for i, ratio in enumerate(RATIOS):
            root = np.sqrt(basis.shape(ratio))
            values, vectors = np.linalg.eigh(gram / np.outer(root, root))
            turned = vectors.T @ (moment / root[:, None])
            seen = (basis.g[held] / root) @ vectors
            for j, penalty in enumerate(PENALTIES):
                shrunk = turned / (values + penalty * len(kept))[:, None]
                left[i, j, held] = rho[held] - seen @ shrunk
    scores = np.sum(left**2, axis=2)
    choice, residuals = [], np.empty_like(rho)
    for axis in range(rho.shape[1]):
        best, penalty = divmod(int(np.argmin(scores[:, :, axis])), len(PENALTIES))
        choice.append((RATIOS[best], PENALTIES[penalty]))
        residuals[:, axis] = left[best, penalty, :, axis]
    return HeldOut(tuple(choice), residuals)


def fit(basis: Basis, rho: Array, choice: Sequence[tuple[float, float]]) -> Array:
    """Return coefficients of raw features, shape (p, 3); Huber weights per axis."""
    n = len(rho)
    columns = []
    for axis, (ratio, penalty) in enumerate(choice):
        ridge = np.diag(penalty * n * basis.shape(ratio))
        y = rho[:, axis]
        weights: Array = np.ones(n)
        c: Array = np.zeros(basis.g.shape[1])
        for _ in range(PASSES):
            weighted = basis.g * weights[:, None]
            solved = np.linalg.solve(weighted.T @ basis.g + ridge, weighted.T @ y)
            c = np.asarray(solved, dtype=np.float64)
            sizes = np.abs(y - basis.g @ c)
            weights = huber_weights(sizes, robust_scale(sizes))
        columns.append(c)
    found: Array = basis.back @ np.stack(columns, axis=1)
    return found
