r"""Effect of the parent's marker noise on a point in the parent's coordinates.

The parent's frame is fitted to noisy markers. A rotation error of this fit moves a point in
proportion to its lever arm. The error is large if the parent's markers are close to each other or
if the lever arm is long. It is common to all markers of the child.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array


def spatial_noise(points: Array, parent: Array, noise: float) -> Array:
    r"""Return the covariance of points in the coordinates of a frame fitted to noisy markers.

    .. math:: Σ_x = σ^2 \left[ \left(1 + \tfrac1m\right) I + [λ]_× G^{-1} [λ]_×^T \right],
              \quad G = \sum_j \left(|d_j|^2 I - d_j d_j^T\right), \quad λ = x - \bar y,
              \quad d_j = y_j - \bar y

    to first order in the noise, for a frame that is fitted by the method of Kabsch with equal
    weights. σ is the noise of the m parent markers y_j, ȳ their mean, and λ the lever arm of the
    point x.

    Parameters
    ----------
    points : ndarray, shape (..., 3)
        Points in the parent's coordinates, m.
    parent : ndarray, shape (m, 3)
        The parent's markers in its own coordinates, m.
    noise : float
        Standard deviation of every coordinate of every marker, m.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Covariance of each point, m².

    Raises
    ------
    ValueError
        The markers do not determine a frame: there are fewer than three, or all are on a line.
    """
    middle = parent.mean(axis=0)
    d = parent - middle
    G = np.trace(d.T @ d) * np.eye(3) - d.T @ d

    # if all markers are on a line, a rotation about this line moves no marker
    if len(parent) < 3 or float(np.linalg.eigvalsh(G)[0]) < 1e-9 * float(np.trace(G)):
        raise ValueError("a frame needs three markers that are not on a line: move one aside")
    L = rotation.skew(np.asarray(points, dtype=np.float64) - middle)
    turned = L @ np.linalg.inv(G) @ np.swapaxes(L, -1, -2)
    return np.asarray(noise**2 * ((1.0 + 1.0 / len(parent)) * np.eye(3) + turned))


def turn_noise(parent: Array, noise: float) -> float:
    r"""Return the RMS rotation error of a frame fitted to noisy markers, rad.

    The error is the rotation error about the axis with the largest error.

    .. math:: σ_φ^2 = σ^2\, λ_{max}(G^{-1})

    Parameters
    ----------
    parent : ndarray, shape (m, 3)
        The parent's markers in its own coordinates, m.
    noise : float
        Standard deviation of every coordinate of every marker, m.
    """
    d = parent - parent.mean(axis=0)
    stiff = float(np.linalg.eigvalsh(np.trace(d.T @ d) * np.eye(3) - d.T @ d)[0])
    return noise / stiff**0.5 if stiff > 0.0 else np.inf


def relative(points: Array, parent: Array, center: Array) -> Array:
    r"""Return the noise covariance of each marker, scaled so that its mean radial variance is 1.

    .. math:: S_j = Σ_c / \overline{\hat r_j^T Σ_c \hat r_j}, \qquad
              Σ_c = \left(1 + \tfrac1m\right) I + [λ_c]_× G^{-1} [λ_c]_×^T

    where :math:`λ_c` is the lever arm of the center, not of the marker, and :math:`\hat r_j` the
    unit vector from the center to marker j. `spatial_noise` defines G. A rotation error of the
    parent's frame rotates the markers and the true center together, and does not change their
    distance. The distance from the estimated center changes only by the displacement of the true
    center, whose lever arm is :math:`λ_c`.

    Parameters
    ----------
    points : ndarray, shape (n, k, 3)
        Markers in the parent's coordinates, m; NaN where missing.
    parent : ndarray, shape (m, 3)
        The parent's markers, m.
    center : ndarray, shape (3,)
        Approximate position of the center, m.

    Returns
    -------
    ndarray, shape (k, 3, 3)
        Relative noise covariance of each marker, for `RunningSphere`. For a marker that is never
        visible, the mean over all directions replaces the mean over the frames.
    """
    seen = np.asarray(np.isfinite(points).all(axis=-1), dtype=np.float64)
    S = spatial_noise(center, parent, 1.0)
    spoke = np.where(seen[..., None] > 0.0, points, center + 1.0) - center
    spoke = spoke / np.maximum(np.linalg.norm(spoke, axis=-1, keepdims=True), 1e-9)
    radial = np.einsum("tja,ab,tjb->tj", spoke, S, spoke)
    total = seen.sum(axis=0)
    along = (seen * radial).sum(axis=0) / np.maximum(total, 1.0)
    along = np.where(total > 0.0, along, np.trace(S) / 3)

    return np.asarray(S / np.maximum(along, 1e-300)[:, None, None])
