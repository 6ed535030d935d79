"""Theory of circle centers: Cramér-Rao bounds, and errors of centers computed from three frames.

The bound is the smallest variance of an unbiased estimate. It depends on the movement and the
noise, but not on the estimator. It is infinite if the movement contains no information about the
center.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation import CenterEstimate


def circle_bound(angles: ArrayLike, noise: float, *, known_radius: bool = False) -> Array:
    r"""Return the smallest covariance of a circle's center from points at these angles.

    .. math:: C = \sigma^2 \Big[ \sum_i u_i u_i^T \Big]^{-1}_{xy},
              \qquad u_i = (\cos\theta_i, \sin\theta_i, 1)

    Here θ_i is angle i, and σ is `noise`. If the radius is known, u_i does not contain the 1.

    Parameters
    ----------
    angles : array_like, shape (n,)
        Directions of the points from the center, rad.
    noise : float
        Standard deviation of each coordinate, m.
    known_radius : bool
        Whether the radius is known.

    Returns
    -------
    ndarray, shape (2, 2)
        Covariance, m²; inf on the diagonal if the points determine no center.
    """
    t = np.asarray(angles, dtype=np.float64)
    columns = [np.cos(t), np.sin(t)]
    if not known_radius:
        columns.append(np.ones_like(t))
    u = np.column_stack(columns)
    F = u.T @ u  # noqa: N806 - Fisher's information is a matrix
    scale = float(np.trace(F))
    if t.size == 0 or float(np.linalg.eigvalsh(F)[0]) <= 1e-15 * scale:
        return np.diag([np.inf, np.inf])
    return np.asarray(noise**2 * np.linalg.inv(F)[:2, :2])


def circle_rms_bound(angles: ArrayLike, noise: float, *, known_radius: bool = False) -> float:
    """Return the smallest RMS error of a circle's center, m; parameters as in `circle_bound`."""
    return float(np.sqrt(np.trace(circle_bound(angles, noise, known_radius=known_radius))))


def arbitrary_error(angles: ArrayLike, noise: ArrayLike) -> Array:
    r"""Predict the RMS error of a center that is computed from one marker in three frames.

    .. math::
        E^2 = \frac{2\sigma^2 (3 - \cos\theta_{12} - \cos\theta_{13} - \cos\theta_{23})}
                   {(\sin\theta_{12} - \sin\theta_{13} + \sin\theta_{23})^2}

    Here θ_ij is the angle of frame i minus the angle of frame j, and σ is `noise`. Source:
    Akbarifar et al. 2021, equation 14 with the sign of the last cosine corrected.

    Parameters
    ----------
    angles : array_like, shape (..., 3)
        Directions of the marker from the center in the three frames, rad.
    noise : array_like, shape (...)
        Standard deviation of each coordinate, m.

    Returns
    -------
    ndarray, shape (...)
        RMS distance from the true center, m; inf if two angles coincide.
    """
    t = np.asarray(angles, dtype=np.float64)
    d12, d13, d23 = t[..., 0] - t[..., 1], t[..., 0] - t[..., 2], t[..., 1] - t[..., 2]
    across = np.sin(d12) - np.sin(d13) + np.sin(d23)

    # 1 - cos is computed from half angles, because the difference is imprecise on short arcs.
    square = 4.0 * (np.sin(d12 / 2) ** 2 + np.sin(d13 / 2) ** 2 + np.sin(d23 / 2) ** 2)
    return _ratio(np.asarray(noise) * np.sqrt(square), np.abs(across))


def triangle_error(points: ArrayLike, noise: ArrayLike) -> Array:
    r"""Predict the same error as `arbitrary_error`, from the measured positions instead of angles.

    .. math:: E = \sigma \frac{R}{2A} \sqrt{a^2 + b^2 + c^2}, \qquad R = abc / 4A

    Here a, b and c are the sides of the triangle of the three positions, A is its area, R is the
    radius of the circle through the positions, and σ is `noise`.

    Parameters
    ----------
    points : array_like, shape (..., 3, 2)
        Positions in the three frames, m.
    noise : array_like, shape (...)
        Standard deviation of each coordinate, m.

    Returns
    -------
    ndarray, shape (...)
        RMS distance from the true center, m; inf if the points are on a line.
    """
    p = np.asarray(points, dtype=np.float64)
    u, v = p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :]
    sides = np.stack([(w**2).sum(axis=-1) for w in (u, v, u - v)], axis=-1)
    area = np.abs(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]) / 2
    error = np.asarray(noise) * np.sqrt(sides.prod(axis=-1) * sides.sum(axis=-1))
    return _ratio(error, 8.0 * area**2)


def _ratio(above: Array, below: Array) -> Array:
    """Return above / below, or inf where `below` is 0, that is, without information."""
    lost = below <= 0.0
    return np.where(lost, np.inf, above / np.where(lost, 1.0, below))


def combine(estimates: list[CenterEstimate]) -> tuple[Array, Array]:
    r"""Combine estimates of one center from markers with independent errors.

    The weights are the inverse covariances. Outliers are not rejected. Estimates with an unobserved
    direction are ignored.

    .. math:: C = \Big( \sum_k C_k^{-1} \Big)^{-1}, \qquad c = C \sum_k C_k^{-1} c_k

    Here c_k and C_k are the center and the covariance of marker k.

    Returns
    -------
    center, covariance : ndarray, shapes (d,) and (d, d)
        Center, m, and covariance, m².
    """
    usable = [e for e in estimates if len(e.unseen) == 0]
    information = [np.linalg.inv(e.covariance) for e in usable]
    covariance = np.linalg.inv(np.sum(information, axis=0))
    pulls = [W @ e.center for W, e in zip(information, usable, strict=True)]
    return np.asarray(covariance @ np.sum(pulls, axis=0)), covariance
