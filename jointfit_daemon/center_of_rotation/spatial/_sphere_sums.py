r"""Sums over the frames of a movement, from which spheres can be fitted without the frames.

The size of the sums does not depend on the number of frames.

Every marker has the vector φ = (|p|², p, 1), where p is the position of the marker relative to a
fixed point near the marker. All estimates of spheres about one center are functions of

.. math:: M_{jl} = \sum_t \sqrt{w_{tj} w_{tl}}\, φ_{tj} φ_{tl}^T, \qquad
          L_{gj} = \sum_t \sqrt{w_{tj} w_{t-g,j}}\, φ_{tj} φ_{t-g,j}^T, \quad g \in \{1, 4\}

where w is the weight of marker j or l in frame t. M determines the variance of the residuals of
each marker, and their covariance between two markers. Noise of the parent's frame causes this
covariance. L determines the correlation of the residuals in time. To forget old frames, M and L are
multiplied by a factor below 1. A marker that is not visible adds nothing to either sum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

LAGS = (1, 4)
"""Lags in frames. Noise whose correlation halves from frame to frame is almost uncorrelated over
the second lag.
"""


@dataclass(frozen=True, slots=True)
class SphereSums:
    """Sums over the frames of k markers in d dimensions; e is d + 2."""

    origin: Array
    """Fixed point of each marker, m, shape (k, d)."""
    M: Array
    """Sums of the products of φ of two markers, shape (k, e, k, e)."""
    L: Array
    """Lagged sums for each of `LAGS`, shape (2, k, e, e)."""
    squares: Array
    """Sum of the squared weights of each marker, Σ w², shape (k,)."""
    frames: int
    """Number of frames with any visible marker."""

    @property
    def weights(self) -> Array:
        """Return the sum of the weights of each marker, Σ w, shape (k,)."""
        last = self.M.shape[1] - 1
        return np.asarray(np.einsum("jj->j", self.M[:, last, :, last]).copy())

    @property
    def counts(self) -> Array:
        """Return the effective number of frames of each marker, (Σw)²/Σw², shape (k,)."""
        return np.asarray(self.weights**2 / np.maximum(self.squares, 1e-300))

    def only(self, markers: NDArray[np.bool_]) -> SphereSums:
        """Return the sums of the markers that are selected by a mask."""
        pick = np.flatnonzero(markers)
        M = self.M[pick][:, :, pick]
        return SphereSums(self.origin[pick], M, self.L[:, pick], self.squares[pick], self.frames)


def sum_up(points: Array, weights: Array | None = None) -> SphereSums:
    """Return the sums over all frames.

    Parameters
    ----------
    points : ndarray, shape (n, k, d)
        Positions of the markers, m; NaN where a marker is not visible.
    weights : ndarray, shape (n, k), optional
        Weights of the markers, non-negative; one if None.
    """
    seen = np.asarray(np.isfinite(points).all(axis=-1))
    w = np.where(seen, 1.0 if weights is None else weights, 0.0)
    known = np.where(seen[..., None], points, 0.0)
    origin = known.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)[:, None]
    p = np.where(seen[..., None], points, origin) - origin
    square = (p * p).sum(axis=-1, keepdims=True)
    raised = np.concatenate((square, p, np.ones_like(square)), axis=-1)
    phi = np.sqrt(w)[..., None] * raised
    n, k, e = phi.shape
    flat = phi.reshape(n, k * e)
    M = (flat.T @ flat).reshape(k, e, k, e)
    L = np.stack([np.einsum("tja,tjb->jab", phi[g:], phi[:-g]) for g in LAGS])

    return SphereSums(origin, M, L, (w * w).sum(axis=0), int(np.count_nonzero(seen.any(axis=1))))


def center_sums(sums: SphereSums) -> SphereSums:
    r"""Return the sums about the mean of each marker; markers without frames are unchanged.

    If the fixed point of a marker changes, φ is multiplied by a matrix T. The sums are then
    :math:`M' = T M T^T` and :math:`L' = T L T^T`.
    """
    k, d = sums.origin.shape
    by = np.einsum("jaj->ja", sums.M[:, 1:-1, :, -1])
    by = by / np.maximum(sums.weights, 1e-300)[:, None]

    T = np.tile(np.eye(d + 2), (k, 1, 1))
    T[:, 0, 1:-1] = -2.0 * by
    T[:, 0, -1] = (by * by).sum(axis=-1)
    T[:, 1:-1, -1] = -by
    M = np.einsum("jab,jblc,ldc->jald", T, sums.M, T)
    L = np.einsum("jab,gjbc,jdc->gjad", T, sums.L, T)
    return SphereSums(sums.origin + by, M, L, sums.squares, sums.frames)
