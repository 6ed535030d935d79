r"""Error of a center that is computed from three frames, from the noise of each coordinate.

The marker is at distance r from the center, at the angles θ₁, θ₂, θ₃. Source: Akbarifar et al.
2021, section 2-2-2. The following misprints of the source are corrected here. In equation 12, the
denominator contains a superfluous factor s, and a sum of sines instead of a difference. In equation
13, the terms of second order have the wrong sign. The source calls mean squares standard
deviations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array


def three_frame_error(angles: ArrayLike, radius: ArrayLike, errors: ArrayLike) -> Array:
    r"""Return the exact error of the center for given errors of the coordinates.

    .. math::
        \hat x = \frac{1}{2 \tilde D} \sum_i u_i (\tilde y_j - \tilde y_k), \qquad
        \hat y = -\frac{1}{2 \tilde D} \sum_i u_i (\tilde x_j - \tilde x_k), \qquad
        u_i = 2 r (ε_{xi} \cos θ_i + ε_{yi} \sin θ_i) + ε_{xi}^2 + ε_{yi}^2

    where i, j, k are cyclic, ε are the errors, and :math:`\tilde D` is twice the signed area of the
    measured triangle. Source: corrected equations 12 and 13, with the terms of second order that
    the source omits.

    Parameters
    ----------
    angles : array_like, shape (..., 3)
        Directions of the marker from the center in the three frames, rad.
    radius : array_like, shape (...)
        Distance of the marker from the center, m.
    errors : array_like, shape (..., 3, 2)
        Errors of the measured x and y in each frame, m.

    Returns
    -------
    ndarray, shape (..., 2)
        Estimated minus true center, m; not finite if the measured points are on a line.
    """
    t, e = np.asarray(angles, dtype=np.float64), np.asarray(errors, dtype=np.float64)
    r = np.asarray(radius, dtype=np.float64)[..., None]
    spoke = np.stack((np.cos(t), np.sin(t)), axis=-1)
    p = r[..., None] * spoke + e
    u = 2.0 * r * (spoke * e).sum(axis=-1) + (e**2).sum(axis=-1)

    side = _next(p) - _next(_next(p))
    double_area = (p[..., 0] * side[..., 1]).sum(axis=-1)
    along_x, along_y = (u * side[..., 1]).sum(axis=-1), (u * side[..., 0]).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.stack((along_x, -along_y), axis=-1) / (2.0 * double_area)[..., None])


def three_frame_mean_squares(angles: ArrayLike, noise: ArrayLike) -> Array:
    r"""Predict the mean square errors of a three-frame center along x and y.

    .. math::
        E[\hat x^2] = \frac{1}{Q^2} \sum_i (σ_{xi}^2 \cos^2 θ_i + σ_{yi}^2 \sin^2 θ_i)
                      (\sin θ_j - \sin θ_k)^2, \qquad
        Q = \sin(θ_1 - θ_2) - \sin(θ_1 - θ_3) + \sin(θ_2 - θ_3)

    where i, j, k are cyclic and σ are the standard deviations of the coordinates. The mean square
    along y has cosines instead of sines in the second factor. The prediction is of first order in
    the noise, and the radius cancels. If all standard deviations are equal, the sum of the two mean
    squares is equation 14 with its last sign corrected.

    Parameters
    ----------
    angles : array_like, shape (..., 3)
        Directions of the marker from the center in the three frames, rad.
    noise : array_like, broadcast to (..., 3, 2)
        Standard deviations of x and y in each frame, m. The shape is (3, 2) for six values, (3, 1)
        for one value per frame, (2,) for one value per axis, or () for one value.

    Returns
    -------
    ndarray, shape (..., 2)
        Mean square errors along x and y, m²; inf where two of the angles coincide.
    """
    t = np.asarray(angles, dtype=np.float64)
    spoke = np.stack((np.cos(t), np.sin(t)), axis=-1)
    variance = np.broadcast_to(np.asarray(noise, dtype=np.float64) ** 2, spoke.shape)
    radial = (variance * spoke**2).sum(axis=-1, keepdims=True)
    side = (_next(spoke) - _next(_next(spoke)))[..., ::-1]
    above = (radial * side**2).sum(axis=-2)

    # Q is twice the area of the triangle on the unit circle; areas near the rounding error count as
    # zero
    double_area = (spoke[..., 0] * side[..., 0]).sum(axis=-1)[..., None]
    lost = np.abs(double_area) < 1e-15
    return np.where(lost, np.inf, above / np.where(lost, 1.0, double_area) ** 2)


def _next(x: Array) -> Array:
    """Return the values of the next frame, cyclic, for arrays of shape (..., 3, 2)."""
    return np.roll(x, -1, axis=-2)
