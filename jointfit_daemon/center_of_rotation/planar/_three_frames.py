"""Center of rotation from three frames, as the circle through three points in closed form.

A circle through three points has no residual. The error is therefore predicted from the given noise
and the sides of the triangle. A degenerate triangle is refused.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation._result import CenterEstimate
from jointfit_daemon.center_of_rotation.planar._circle_estimate import refused_circle
from jointfit_daemon.center_of_rotation.planar._moments import seen_places

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.arrays import Array

FLAT = 1e-9
"""Ratio of twice the area of a triangle to the square of its longest side. Below this ratio the
three points count as a line.
"""


def three_frame_center(points: ArrayLike) -> Array:
    r"""Return the center of the circle through three points, for any number of triples.

    .. math::
        D &= (x_2-x_1)(y_3-y_1) - (x_3-x_1)(y_2-y_1) \\
        x_c &= x_1 + \left[ s_2 (y_3-y_1) - s_3 (y_2-y_1) \right] / 2D \\
        y_c &= y_1 + \left[ s_3 (x_2-x_1) - s_2 (x_3-x_1) \right] / 2D,
        \qquad s_i = |p_i - p_1|^2

    Source: Akbarifar et al. 2021, equations 7 and 8. This implementation uses coordinates relative
    to the first point, because squares of large coordinates lose digits.

    Parameters
    ----------
    points : array_like, shape (..., 3, 2)
        Positions of one marker in three frames, in the parent's coordinates, m. The frames need not
        be successive. The first, the middle and the last frame of an arc result in the smallest
        error.

    Returns
    -------
    ndarray, shape (..., 2)
        Centers, m. They are inf if the points are on a line or two are equal, and NaN only if a
        point is NaN.
    """
    p = np.asarray(points, dtype=np.float64)
    u, v, size = _sides(p)
    offset, flat = _offset(u, v)
    flat = (flat | np.isinf(size))[..., None]

    return np.where(flat, inf, p[..., 0, :] + size[..., None] * offset)


def _sides(p: Array) -> tuple[Array, Array, Array]:
    """Return the vectors from the first point to the other two, divided by `size`, and `size`, m.

    `size` is the largest coordinate of both vectors. Without the division, squares of implausible
    coordinates would underflow or overflow.
    """
    u, v = p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :]
    size = np.maximum(np.abs(u).max(axis=-1), np.abs(v).max(axis=-1))
    scale = np.where(size > 0.0, size, 1.0)[..., None]
    return u / scale, v / scale, size


def _offset(u: Array, v: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the vector from the first point to the center, and a mask of triples on a line.

    The vector has the scale of u and v, which `_sides` returns.
    """
    D = u[..., 0] * v[..., 1] - v[..., 0] * u[..., 1]
    s2, s3 = (u**2).sum(axis=-1), (v**2).sum(axis=-1)
    longest = np.maximum(np.maximum(s2, s3), ((u - v) ** 2).sum(axis=-1))
    flat = np.abs(D) <= FLAT * longest
    safe = np.where(flat, 1.0, 2.0 * D)
    x = (s2 * v[..., 1] - s3 * u[..., 1]) / safe
    y = (s3 * u[..., 0] - s2 * v[..., 0]) / safe
    return np.stack((x, y), axis=-1), flat


def three_frame_estimate(points: ArrayLike, noise: ArrayLike) -> CenterEstimate:
    """Estimate a center from three points, with the error predicted from the given noise.

    Parameters
    ----------
    points : array_like, shape (3, 2)
        One marker in three frames, m.
    noise : array_like, broadcast to (3, 2)
        Standard deviations of x and y in each frame, m. They must be given, because three points do
        not determine them. The shape is (3, 2) for six values, (3, 1) for one value per frame,
        (2,) for one value per axis, or () for one value.

    Returns
    -------
    CenterEstimate
        Estimate with a covariance propagated to first order. The estimate is refused if a point is
        missing, if the points are on a line, or if the predicted error exceeds a sixth of the
        radius.
    """
    p = np.asarray(points, dtype=np.float64)
    variances = np.broadcast_to(np.asarray(noise, dtype=np.float64) ** 2, (3, 2))
    typical = sqrt(float(variances.mean()))
    if not seen_places(p).all():
        return _refusal(
            p, typical, "a marker is missing in one of the three frames: choose other frames"
        )
    u, v, size = _sides(p)
    offset, flat = _offset(u, v)
    if flat or not np.isfinite(size):
        reason = "the three points are on a line or repeat: choose frames further apart"
        return _refusal(p, typical, reason)

    spokes = np.stack((-offset, u - offset, v - offset))
    # Radial noise e shifts the center by δ, with u·δ = r (e₂ - e₁) and v·δ = r (e₃ - e₁). Hence C =
    # r² A⁻¹ [[σ₁² + σ₂², σ₁²], [σ₁², σ₁² + σ₃²]] A⁻ᵀ with A = (u v)ᵀ and the radial variances σ².
    # The sides u, v and the radius r are divided by `size`; this factor cancels in C.
    moves = float(np.hypot(*offset)) * np.linalg.inv(np.stack((u, v)))
    first, second, third = (variances * spokes**2).sum(axis=1) / (spokes**2).sum(axis=1)
    chords = np.array([[first + second, first], [first, first + third]])
    covariance = np.asarray(moves @ chords @ moves.T)
    error = sqrt(float(np.trace(covariance)))
    radius = float(size * np.hypot(*offset))

    # If the error exceeds a sixth of the radius, the mean square error is not finite.
    lost = f"noise of {1000 * typical:.1f} mm hides the arc: choose frames further apart"
    turned = np.unwrap(np.arctan2(spokes[:, 1], spokes[:, 0]))
    return CenterEstimate(
        method="three_frames",
        center=p[0] + size * offset,
        covariance=covariance,
        noise=typical,
        residual=0.0,
        radii=np.array([radius]),
        arc=float(np.ptp(turned)),
        bound=error,
        conditioning=radius / error if error > 0.0 else inf,
        frames=3,
        effective_frames=3.0,
        refused=lost if 6.0 * error > radius else None,
    )


def equal_step_error(step: ArrayLike, noise: ArrayLike) -> Array:
    r"""Predict the RMS error of a three-frame center for equal steps between the frames.

    .. math:: E^2 = \sigma^2 \frac{2 + \cos\alpha}{(1 - \cos\alpha)^2 (1 + \cos\alpha)}

    where α is the step and σ the noise. Source: Akbarifar et al. 2021, equation 15, which is of
    first order in the noise. E is the Cramér-Rao bound of three points. The prediction is valid
    while noise/radius is below (1 - cos α)/6; above this ratio the error has no finite mean square.
    The minimum of E is 1.155 σ at 120°.

    Parameters
    ----------
    step : array_like, shape (...)
        Angle from frame to frame, rad.
    noise : array_like, shape (...)
        Standard deviation of each coordinate, m.

    Returns
    -------
    ndarray, shape (...)
        RMS distance from the true center, m; inf for the steps 0 and π.
    """
    a = np.asarray(step, dtype=np.float64)
    one_less = 2.0 * np.sin(a / 2) ** 2
    one_more = 2.0 * np.cos(a / 2) ** 2

    # at the floating-point number nearest to π, 1 + cos α is only a rounding error
    one_more = np.where(one_more < 1e-30, 0.0, one_more)
    error = np.asarray(noise) * np.sqrt(1.0 + one_more)
    below = one_less * np.sqrt(one_more)
    lost = below <= 0.0
    return np.where(lost, inf, error / np.where(lost, 1.0, below))


def _refusal(points: Array, noise: float, reason: str) -> CenterEstimate:
    seen = points[seen_places(points)]
    middle = seen.mean(axis=0) if len(seen) else np.zeros(2)
    return replace(refused_circle("three_frames", middle, len(seen), reason), noise=noise)
