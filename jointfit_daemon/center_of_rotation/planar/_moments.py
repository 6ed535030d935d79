"""Central moments of the points of a circle, and the fit statistics derived from them.

Invariant: fit, noise and covariance depend only on nine moments. Batch, windowed and forgetting
fits with the same moments therefore return the same result. Every formula accepts floats (one
circle) and arrays (many circles).
"""

from __future__ import annotations

from math import exp, inf, log
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import numpy as np

from jointfit_daemon.arrays import Array

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

Number = TypeVar("Number", float, Array)

GATE = 6.0
"""Smallest T of a published center; `CenterEstimate.conditioning` defines T. If T is at least this
value, the error is within 15 % of the Cramér-Rao bound.
"""
LOG_20 = log(20.0)
FARTHEST_M = 1e4
"""Largest valid coordinate, m; larger coordinates are treated as missing, like NaN."""
ROUNDING = 1e-13
"""Fraction of the points' variance below which a difference of moments is attributed to rounding.
"""


class CircleMoments(NamedTuple, Generic[Number]):
    """Weighted moments of points about their centroid.

    The fields ``xx`` to ``zz`` are weighted means of products. In a product, x and y are the
    coordinates of a point relative to the centroid, m, and z = x² + y².
    """

    weight: Number
    """Sum of the weights."""
    effective: Number
    """Equivalent number of points of equal weight, (Σw)²/Σw²."""
    x: Number
    """Coordinate x of the centroid, m."""
    y: Number
    """Coordinate y of the centroid, m."""
    xx: Number
    """Weighted mean of x·x, m². The names of the fields below state their products in the same way.
    """
    xy: Number
    yy: Number
    xz: Number
    yz: Number
    zz: Number


class CircleStatistics(NamedTuple, Generic[Number]):
    """Statistics of a circle with the center (a, b) relative to the centroid."""

    noise: Number
    """Variance of each coordinate of a point, m²."""
    residual: Number
    """Mean square of the radial residuals, m²."""
    bound: Number
    """Cramér-Rao bound of the mean square error at this noise, m²."""
    xx: Number
    """Element of the covariance of the center, m², like ``xy`` and ``yy``."""
    xy: Number
    yy: Number
    largest: Number
    """Larger eigenvalue of the covariance, m²."""


def seen_places(points: Array) -> NDArray[np.bool_]:
    """Return a mask, shape (...), of the points, shape (..., 2), that are valid measurements."""
    return np.asarray((np.abs(points) < FARTHEST_M).all(axis=-1))


def moments_of(points: ArrayLike, weights: ArrayLike | None = None) -> CircleMoments[Array]:
    """Return the moments of point sets; the number of sets is arbitrary.

    Parameters
    ----------
    points : array_like, shape (..., n, 2)
        Points of each set, m; a point with NaN has no weight.
    weights : array_like, shape (..., n), optional
        Weight of each point, not negative; 1 if None.

    Returns
    -------
    CircleMoments
        Arrays of shape (...); zeros where all points are missing.
    """
    p = np.asarray(points, dtype=np.float64)
    seen = seen_places(p)
    w = np.where(seen, 1.0 if weights is None else np.asarray(weights, dtype=np.float64), 0.0)
    p = np.where(seen[..., None], p, 0.0)
    total = w.sum(axis=-1)
    share = w / np.where(total > 0.0, total, 1.0)[..., None]
    squares = (w**2).sum(axis=-1)
    effective = total**2 / np.where(squares > 0.0, squares, 1.0)
    middle = np.einsum("...n,...nd->...d", share, p)
    d = p - middle[..., None, :]
    x, y = d[..., 0], d[..., 1]
    z = x**2 + y**2
    z = z - (share * z).sum(axis=-1)[..., None]
    pairs = ((x, x), (x, y), (y, y), (x, z), (y, z))
    means = [np.einsum("...n,...n,...n->...", share, u, v) for u, v in pairs]

    # Mzz is computed as var z + (Mxx + Myy)², because this sum does not cancel
    zz = np.einsum("...n,...n,...n->...", share, z, z) + (means[0] + means[2]) ** 2
    xx, xy, yy, xz, yz = means
    return CircleMoments(total, effective, middle[..., 0], middle[..., 1], xx, xy, yy, xz, yz, zz)


def moments_of_one(points: Array, weights: Array | None = None) -> CircleMoments[float]:
    """Return the moments of one set of points, shape (n, 2), without NaN; faster than `moments_of`.

    Weights, shape (n,), are not negative and not all zero.
    """
    n = len(points)
    w = weights if weights is not None else np.ones(n)
    total = float(w.sum())
    middle = w @ points / total
    columns = np.empty((3, n))
    np.subtract(points.T, middle[:, None], out=columns[:2])
    np.einsum("cn,cn->n", columns[:2], columns[:2], out=columns[2])
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = ((columns * (w / total)) @ columns.T).tolist()
    effective = total * total / float(w @ w)
    x, y = middle.tolist()

    return CircleMoments(total, effective, x, y, xx, xy, yy, xz, yz, zz)


def sum_of_squares(m: CircleMoments[Number], a: Number, b: Number, square: Number) -> Number:
    r"""Return the mean of (|p - c|² - R²)² for the center (a, b) relative to the centroid, m⁴.

    .. math:: U = M_{zz} + 4a^2 M_{xx} + 4b^2 M_{yy} + 8ab M_{xy} + c_0^2
              - 4a M_{xz} - 4b M_{yz} - 2 c_0 M_z, \qquad c_0 = R^2 - a^2 - b^2
    """
    c0 = square - a * a - b * b
    return (
        (m.zz - 2.0 * c0 * (m.xx + m.yy) + c0 * c0)
        + 4.0 * (a * a * m.xx + b * b * m.yy + 2.0 * a * b * m.xy)
        - 4.0 * (a * m.xz + b * m.yz)
    )


def noise_of(
    m: CircleMoments[Number], a: Number, b: Number, square: Number
) -> tuple[Number, Number]:
    """Return the noise variance of a coordinate and the mean square of the radial residuals, m².

    The parameters have the same meaning as in `circle_statistics`.
    """
    u = sum_of_squares(m, a, b, square)
    u = (u + abs(u)) * 0.5  # negative only by rounding of a perfect fit
    residual = u / (4.0 * square)
    return residual * m.effective / (m.effective - 3.0), residual


def arc_shows(m: CircleMoments[Number], noise: Number) -> Any:
    """Return whether the covariance of the points minus the noise covariance is positive definite.

    Otherwise the arc does not exceed the noise, and variances of `circle_statistics` may be
    negative.
    """
    sxx, syy = m.xx - noise, m.yy - noise
    trace = sxx + syy
    return (trace > 0.0) & (sxx * syy - m.xy * m.xy > ROUNDING * trace * trace)


def circle_statistics(
    m: CircleMoments[Number], a: Number, b: Number, square: Number
) -> CircleStatistics[Number]:
    r"""Return noise and covariance of a fitted circle.

    .. math::
        \hat\sigma^2 &= \frac{n}{n-3} \frac{U}{4R^2} \\
        S &= \begin{bmatrix} M_{xx} & M_{xy} \\ M_{xy} & M_{yy} \end{bmatrix}
            - \hat\sigma^2 I, \qquad \lambda_1 \ge \lambda_2 \text{ its eigenvalues} \\
        \mathrm{Cov} &= \frac{\hat\sigma^2 R^2}{n} S^{-1} \left( 1 + \left(5 -
            \tfrac52 \sqrt{\lambda_2/\lambda_1}\right) \hat\sigma^2/\lambda_1 \right)

    where n is the effective number of points. The noise variance is subtracted from the moments,
    because the width that noise adds to the path would count as curvature. Without the subtraction,
    the predicted error on an arc of 20° is half the true error. The factor in round brackets
    accounts for noise along the arc, which affects the estimate of the curvature. The constant 5 is
    exact for a parabola with evenly spread abscissas t. Noise on t adds 5σ²/var t to the variance
    of t². The constant 5/2, which applies to a whole circle, was found by simulation. The factor is
    relevant for σ above R/30.

    Parameters
    ----------
    m : CircleMoments
        Moments of at least four effective points, for which `arc_shows` returns true.
    a, b : float or ndarray
        Center relative to the centroid, m.
    square : float or ndarray
        Squared radius R², m², above zero.
    """
    noise, residual = noise_of(m, a, b, square)
    sxx, syy = m.xx - noise, m.yy - noise
    determinant = sxx * syy - m.xy * m.xy
    half, middle = 0.5 * (sxx - syy), 0.5 * (sxx + syy)
    long = middle + (half * half + m.xy * m.xy) ** 0.5
    thin = abs(determinant) ** 0.5 / long
    blurred = 1.0 + (5.0 - 2.5 * thin) * noise / long
    bound = noise * square / (m.effective * determinant)
    scale = blurred * bound

    return CircleStatistics(
        noise, residual, bound * (sxx + syy), scale * syy, -scale * m.xy, scale * sxx, scale * long
    )


def ellipse_scale(effective: float, conditioning: float) -> float:
    r"""Return the squared Mahalanobis distance that contains 95 % of the published centers.

    .. math:: e^T C^{-1} e \le g^2(T)\, \nu \left( 0.05^{-2/\nu} - 1 \right), \qquad \nu = n - 3

    The second factor is twice the quantile of the F distribution with 2 and ν degrees of freedom,
    because the noise is also estimated. The first factor corrects for the selection of published
    centers. A center is published if its T exceeds `GATE`. T is nearly T₀ + N(0, 1), where T₀ is
    the true value. If T₀ is close to the gate, the curvature of most published centers is too
    large, so these centers are too close to the markers. The factor

    .. math:: g(T) = 1 + 12.6\, e^{-(T-6)/0.455} + 0.172\, (6/T)^{2.25}

    was fitted so that 94.9 to 95.1 % of the published centers are covered for any T₀, down to
    movements of which 3 % are published. A test computes this coverage by integration. The last
    term accounts for the asymmetry of the error distribution far from the gate.

    Parameters
    ----------
    effective : float
        Effective number of points, above 3.
    conditioning : float
        Value of T of the center.

    Returns
    -------
    float
        Squared Mahalanobis distance; inf where T is below the gate.
    """
    freedom = effective - 3.0
    if freedom <= 0.0 or conditioning < GATE:
        return inf
    fisher = freedom * (exp(min(LOG_20 * 2.0 / freedom, 600.0)) - 1.0)
    lucky = 12.6 * exp(-(conditioning - GATE) / 0.455)
    return float(fisher * (1.0 + lucky + 0.172 * (GATE / conditioning) ** 2.25) ** 2)
