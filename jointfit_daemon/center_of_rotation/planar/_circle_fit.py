"""Algebraic circle fits in closed form: Kåsa, Pratt, Taubin and Hyper.

The fits need no start value and no iteration over points. They accept one set of points or many
sets at once. Hyper is the default because it has no essential bias, which is the part of the bias
that more points do not reduce. Source: Al-Sharadqah and Chernov 2009.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from jointfit_daemon.center_of_rotation.planar._moments import (
    ROUNDING,
    CircleMoments,
    Number,
    arc_shows,
    circle_statistics,
    moments_of,
    moments_of_one,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.arrays import Array

CircleMethod = Literal["kasa", "pratt", "taubin", "hyper"]

_STEPS = 20


class Circles(NamedTuple):
    """Circles fitted to sets of points; all fields have the leading shape (...)."""

    center: Array
    """Center, m, shape (..., 2); NaN where `valid` is False."""
    radius: Array
    """Radius of the circle, m."""
    covariance: Array
    """Covariance matrix of the center, m², shape (..., 2, 2)."""
    noise: Array
    """Standard deviation of each coordinate of a point, m."""
    conditioning: Array
    """T, the radius divided by the largest standard error of the center."""
    valid: NDArray[np.bool_]
    """Whether a circle exists and its arc exceeds the noise."""


def polynomial(m: CircleMoments[Number], method: str) -> tuple[Number, Number, Number, float]:
    r"""Return the coefficients A0, A1, A2 and the factor of η⁴ of the characteristic polynomial.

    .. math::
        C &= M_{xx} M_{yy} - M_{xy}^2, \qquad V = M_{zz} - M_z^2, \qquad M_z = M_{xx} + M_{yy} \\
        A_0 &= M_{xz}(M_{xz} M_{yy} - M_{yz} M_{xy}) + M_{yz}(M_{yz} M_{xx} - M_{xz} M_{xy}) - VC \\
        A_1 &= V M_z + 4 C M_z - M_{xz}^2 - M_{yz}^2

    M are the moments in `CircleMoments`. For Pratt and Hyper, A₂ = 4C - 3M_z² - M_zz and the
    leading term is 4η⁴. For Taubin, A₂ = -3M_z² - M_zz and the leading term is 4M_z η³.
    """
    z = m.xx + m.yy
    C = m.xx * m.yy - m.xy * m.xy
    V = m.zz - z * z
    A0 = m.xz * (m.xz * m.yy - m.yz * m.xy) + m.yz * (m.yz * m.xx - m.xz * m.xy) - V * C
    A1 = V * z + 4.0 * C * z - m.xz * m.xz - m.yz * m.yz
    A2 = -3.0 * z * z - m.zz
    if method == "taubin":
        return A0, A1, A2, 0.0
    return A0, A1, A2 + 4.0 * C, 4.0


def smallest_root(m: CircleMoments[float], method: str = "hyper") -> float:
    """Return the smallest root η of the characteristic polynomial.

    Newton's method from zero finds it in 5 or 6 steps.
    """
    if method == "kasa":
        return 0.0
    A0, A1, A2, A4 = polynomial(m, method)
    A3 = 4.0 * (m.xx + m.yy) if method == "taubin" else 0.0
    eta, value = 0.0, A0

    for _ in range(_STEPS):
        slope = A1 + eta * (2.0 * A2 + eta * (3.0 * A3 + 4.0 * A4 * eta))
        if slope == 0.0:
            break
        following = eta - value / slope
        after = A0 + following * (A1 + following * (A2 + following * (A3 + A4 * following)))
        if following == eta or abs(after) >= abs(value):
            break
        eta, value = following, after

    return eta


def smallest_roots(m: CircleMoments[Array], method: str = "hyper") -> Array:
    """Return the result of `smallest_root` for many circles at once."""
    if method == "kasa":
        return np.zeros_like(m.xx)
    A0, A1, A2, A4 = polynomial(m, method)
    A3 = 4.0 * (m.xx + m.yy) if method == "taubin" else np.zeros_like(A0)
    eta, value, moving = np.zeros_like(A0), A0, np.ones(A0.shape, dtype=bool)

    for _ in range(_STEPS):
        slope = A1 + eta * (2.0 * A2 + eta * (3.0 * A3 + 4.0 * A4 * eta))
        step = value / np.where(slope == 0.0, np.inf, slope)
        following = eta - step
        after = A0 + following * (A1 + following * (A2 + following * (A3 + A4 * following)))
        moving = moving & (following != eta) & (np.abs(after) < np.abs(value))
        if not moving.any():
            break
        eta, value = np.where(moving, following, eta), np.where(moving, after, value)

    return eta


def circle_from_root(
    m: CircleMoments[Number], eta: Number, method: str = "hyper"
) -> tuple[Number, Number, Number]:
    r"""Return the center (a, b) relative to the centroid, m, and R², m², for a root η with Δ ≠ 0.

    .. math::
        \Delta &= \eta^2 - \eta M_z + C \\
        a &= (M_{xz}(M_{yy} - \eta) - M_{yz} M_{xy}) / 2\Delta \\
        b &= (M_{yz}(M_{xx} - \eta) - M_{xz} M_{xy}) / 2\Delta \\
        R^2 &= a^2 + b^2 + M_z + \{0, 2\eta, 0, -2\eta\}

    The braces contain the terms of the methods ``kasa``, ``pratt``, ``taubin`` and ``hyper``.
    """
    z = m.xx + m.yy
    # Δ = η² - ηMz + C is computed as a difference of products, because the terms of the sum cancel
    # on short arcs
    twice = 2.0 * ((m.xx - eta) * (m.yy - eta) - m.xy * m.xy)
    a = (m.xz * (m.yy - eta) - m.yz * m.xy) / twice
    b = (m.yz * (m.xx - eta) - m.xz * m.xy) / twice
    more = {"pratt": 2.0, "hyper": -2.0}.get(method, 0.0)

    return a, b, a * a + b * b + z + more * eta


def circle_of(m: CircleMoments[float], method: str = "hyper") -> tuple[float, float, float] | None:
    """Return `circle_from_root` of one circle; None if the moments do not determine a circle."""
    eta = smallest_root(m, method)
    if (m.xx - eta) * (m.yy - eta) == m.xy * m.xy:
        return None
    a, b, square = circle_from_root(m, eta, method)
    return (a, b, square) if square > 0.0 else None


def temper(
    a: Number, b: Number, square: Number, cov: tuple[Number, Number, Number]
) -> tuple[Number, Number, tuple[Number, Number, Number]]:
    r"""Shrink a center towards the centroid, against the outward bias that its uncertainty causes.

    .. math:: S = (I + C/R^2)^{-1}, \qquad d' = S d, \qquad C' = S C S

    where d is the vector from the centroid to the center, with covariance C. On a short arc the
    error of the estimated curvature κ is nearly normal with standard deviation s, and the distance
    of the center is 1/κ. The mean square error of 1/κ is dominated by the few cases near κ = 0, and
    1/κ is too large on average. The distance 1/κ is therefore replaced by κ/(κ² + s²), Zellner's
    minimum expected loss estimator of an inverse (1978). The replacement removes the tail of the
    error distribution, and removes the bias to second order. With T = κ/s, the error is 1 + 1/T²
    times the Cramér-Rao bound. Without the replacement the factor is 1 + 4.5/T². On long arcs S is
    nearly the identity.
    """
    xx, xy, yy = cov
    p, q, r = 1.0 + xx / square, xy / square, 1.0 + yy / square
    determinant = p * r - q * q
    s, t, u = r / determinant, -q / determinant, p / determinant

    # the product S C S needs no third matrix, because S C = R² (I - S)
    k, m, n = square * (1.0 - s), -square * t, square * (1.0 - u)
    drawn = (k * s + m * t, k * t + m * u, m * t + n * u)
    return s * a + t * b, t * a + u * b, drawn


def fit_circles(
    points: ArrayLike,
    *,
    method: CircleMethod = "hyper",
    tempered: bool = True,
    correlated: bool = False,
) -> Circles:
    """Fit a circle to each point set; the number of sets is arbitrary.

    Parameters
    ----------
    points : array_like, shape (..., n, 2)
        Points of each set, m; NaN where a marker is not visible.
    method : str
        ``kasa``, ``pratt``, ``taubin`` or ``hyper``.
    tempered : bool
        Whether to shrink centers with `temper`.
    correlated : bool
        Whether to increase the covariance for the correlation between successive residuals. The
        points must then be in order of time.

    Returns
    -------
    Circles
        Circles. `valid` is False, and center and radius are NaN, in these cases: fewer than four
        points, points on a line, points at one position, and arcs that do not exceed the noise.
    """
    m = moments_of(points)
    with np.errstate(all="ignore"):  # results without a circle are masked below
        eta = smallest_roots(m, method)
        a, b, square = circle_from_root(m, eta, method)
        statistics = circle_statistics(m, a, b, square)
        wider = (
            persistence(_lagged_product(points, m, a, b, square) / statistics.residual)
            if correlated
            else np.ones_like(a)
        )
        cov = (wider * statistics.xx, wider * statistics.xy, wider * statistics.yy)
        conditioning = np.sqrt(square / (wider * statistics.largest))
        if tempered:
            a, b, cov = temper(a, b, square, cov)
        z = m.xx + m.yy
        valid = (m.effective > 3.0) & ~(m.xx * m.yy - m.xy**2 <= ROUNDING * z**2) & (square > 0.0)
        valid &= arc_shows(m, statistics.noise) & np.isfinite(a) & np.isfinite(b)

    nan = np.nan
    center = np.where(valid[..., None], np.stack((m.x + a, m.y + b), axis=-1), nan)
    C = np.stack((np.stack((cov[0], cov[1]), -1), np.stack((cov[1], cov[2]), -1)), -1)
    return Circles(
        center,
        np.where(valid, np.sqrt(np.where(valid, square, 1.0)), nan),
        np.where(valid[..., None, None], C, nan),
        np.where(valid, np.sqrt(np.where(valid, statistics.noise, 0.0)), nan),
        np.where(valid, np.where(statistics.noise == 0.0, np.inf, conditioning), 0.0),
        valid,
    )


def fit_circle(points: ArrayLike, *, method: CircleMethod = "hyper") -> tuple[float, float, float]:
    """Return center and radius, m, of one circle, without shrinkage and without acceptance limits.

    Parameters
    ----------
    points : array_like, shape (n, 2)
        Points, m; no NaN.
    method : str
        ``kasa``, ``pratt``, ``taubin`` or ``hyper``.

    Raises
    ------
    ValueError
        There are fewer than three points, or the points are on a line, at one position, or without
        curvature.
    """
    p = np.asarray(points, dtype=np.float64)
    m = moments_of_one(p) if len(p) > 2 else None
    if m is None or not m.xx * m.yy - m.xy * m.xy > ROUNDING * (m.xx + m.yy) ** 2:
        raise ValueError("no circle: at least three points that are not on a line are needed")
    found = circle_of(m, method)
    if found is None:
        raise ValueError("no circle: the points show no arc")
    a, b, square = found
    return m.x + a, m.y + b, square**0.5


def _lagged_product(
    points: ArrayLike, m: CircleMoments[Array], a: Array, b: Array, square: Array
) -> Array:
    """Return the mean product of the radial residuals of successive points, m², shape (...)."""
    p = np.asarray(points, dtype=np.float64)
    d = p - np.stack((m.x + a, m.y + b), axis=-1)[..., None, :]
    e = ((d**2).sum(axis=-1) - square[..., None]) / (2.0 * np.sqrt(square))[..., None]
    product = e[..., 1:] * e[..., :-1]
    both = np.isfinite(product)
    total = np.where(both, product, 0.0).sum(axis=-1)
    return np.asarray(total / np.maximum(both.sum(axis=-1), 1))


def persistence(correlation: Array) -> Array:
    r"""Return :math:`(1+\rho)/(1-\rho)`, the factor on the variance, with ρ limited to 0 … 0.99."""
    rho = np.clip(np.nan_to_num(correlation), 0.0, 0.99)
    return np.asarray((1.0 + rho) / (1.0 - rho))
