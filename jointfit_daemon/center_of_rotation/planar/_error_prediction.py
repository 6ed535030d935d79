"""Predicted error of a center computed from three frames.

The predictions are of first order in the noise and equal the Cramér-Rao bound of three points.
Each function returns the root of the mean square; equations 14 and 15 of the source are mean
squares.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array


def arbitrary_error(angles: ArrayLike, noise: ArrayLike) -> Array:
    r"""Predict the RMS error of a three-frame center for three angles.

    .. math::
        E^2 = \frac{2\sigma^2 (3 - \cos\theta_{12} - \cos\theta_{13} - \cos\theta_{23})}
                   {(\sin\theta_{12} - \sin\theta_{13} + \sin\theta_{23})^2}

    Source: Akbarifar et al. 2021, equation 14 with the sign of the last cosine corrected.

    Parameters
    ----------
    angles : array_like, shape (..., 3)
        Of the marker about the center in the three frames, rad.
    noise : array_like, shape (...)
        Standard deviation of each coordinate, m.

    Returns
    -------
    ndarray, shape (...)
        RMS distance from the true center, m; inf where two angles coincide.
    """
    t = np.asarray(angles, dtype=np.float64)
    d12, d13, d23 = t[..., 0] - t[..., 1], t[..., 0] - t[..., 2], t[..., 1] - t[..., 2]
    Q = np.sin(d12) - np.sin(d13) + np.sin(d23)

    # 1 - cos by half angles: the difference of cosines has no digits on short arcs
    square = 4.0 * (np.sin(d12 / 2) ** 2 + np.sin(d13 / 2) ** 2 + np.sin(d23 / 2) ** 2)
    return _ratio(np.asarray(noise) * np.sqrt(square), np.abs(Q))


def equal_step_error(step: ArrayLike, noise: ArrayLike) -> Array:
    r"""Predict the RMS error of a three-frame center for equal steps between the frames.

    .. math:: E^2 = \sigma^2 \frac{2 + \cos\alpha}{(1 - \cos\alpha)^2 (1 + \cos\alpha)}

    Source: Akbarifar et al. 2021, equation 15. Holds while noise/radius is below (1 - cos α)/6;
    beyond it the error has no finite mean square. Least at 120°: 1.155 σ.

    Parameters
    ----------
    step : array_like, shape (...)
        Angle from frame to frame, rad.
    noise : array_like, shape (...)
        Standard deviation of each coordinate, m.

    Returns
    -------
    ndarray, shape (...)
        RMS distance from the true center, m; inf at 0 and π.
    """
    a = np.asarray(step, dtype=np.float64)
    one_less = 2.0 * np.sin(a / 2) ** 2
    one_more = 2.0 * np.cos(a / 2) ** 2

    # π is not representable: the remaining cosine is rounding
    one_more = np.where(one_more < 1e-30, 0.0, one_more)
    error = np.asarray(noise) * np.sqrt(1.0 + one_more)
    return _ratio(error, one_less * np.sqrt(one_more))


def triangle_error(points: ArrayLike, noise: ArrayLike) -> Array:
    r"""Predict the RMS error of a three-frame center from the measured triangle alone.

    .. math:: E = \sigma \frac{R}{2A} \sqrt{a^2 + b^2 + c^2}, \qquad R = abc / 4A

    with sides a, b, c and area A: no angles and no center are needed, so it can be computed online,
    for every triple, before the center is trusted.

    Parameters
    ----------
    points : array_like, shape (..., 3, 2)
        m.
    noise : array_like, shape (...)
        Standard deviation of each coordinate, m.

    Returns
    -------
    ndarray, shape (...)
        RMS distance from the true center, m; inf where the points are on a line.
    """
    p = np.asarray(points, dtype=np.float64)
    u, v = p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :]
    sides = np.stack([(w**2).sum(axis=-1) for w in (u, v, u - v)], axis=-1)
    area = np.abs(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]) / 2
    error = np.asarray(noise) * np.sqrt(sides.prod(axis=-1) * sides.sum(axis=-1))

    return _ratio(error, 8.0 * area**2)


def _ratio(above: Array, below: Array) -> Array:
    """Divide; no information is an infinite error, noise or not."""
    lost = below <= 0.0
    return np.where(lost, np.inf, above / np.where(lost, 1.0, below))
