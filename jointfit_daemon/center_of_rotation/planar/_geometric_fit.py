"""Geometric circle fit: the maximum-likelihood estimate by Levenberg-Marquardt.

Without outliers the estimate is nearly equal to the estimate of the Hyper fit. In addition, the
geometric fit supports the Huber loss and several markers with one center.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation._path_statistics import (
    lag_one_correlation,
    radial_residuals,
    variance_inflation,
)
from jointfit_daemon.center_of_rotation._result import CenterEstimate
from jointfit_daemon.center_of_rotation.planar._circle_estimate import (
    CircleLimits,
    arc_about,
    objection,
    refused_circle,
)
from jointfit_daemon.center_of_rotation.planar._circle_fit import fit_circles
from jointfit_daemon.center_of_rotation.planar._moments import ROUNDING, ellipse_scale, seen_places

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.arrays import Array


METHOD = "geometric"
HUBER = 1.5
_LEAST_SCALE_M = 1e-4
_PASSES = 60


def geometric_estimate(
    points: ArrayLike,
    *,
    robust: bool = True,
    start: ArrayLike | None = None,
    limits: CircleLimits | None = None,
) -> CenterEstimate:
    r"""Estimate the center of rotation of one or several markers by Levenberg-Marquardt.

    .. math:: \min_c \sum_{tk} \rho\left( |x_{tk} - c| - R_k \right)

    where x_tk is the position of marker k in frame t, R_k the mean distance of marker k from the
    center c, and ρ the Huber loss. If K markers are at different angles about the joint, the error
    is smaller than the error of one marker by much more than the factor √K, because the direction
    with the largest error differs from marker to marker. The correlation r of the residuals of
    successive frames increases the covariance by the factor (1 + r)/(1 - r), as in the other circle
    fits.

    Parameters
    ----------
    points : array_like, shape (n, 2) or (n, k, 2)
        Positions in the parent's coordinates, m; NaN where missing.
    robust : bool
        Whether to use the Huber loss, with a bound of 1.5 standard deviations. The standard
        deviation is estimated from the median residual.
    start : array_like, shape (2,), optional
        Initial center, m; the Hyper fit of the best conditioned marker if None.
    limits : CircleLimits, optional
        Acceptance limits.
    """
    p = np.asarray(points, dtype=np.float64)
    p = p[:, None, :] if p.ndim == 2 else p
    seen = seen_places(p)
    frames = int(seen.any(axis=1).sum())
    if start is None:  # start at the Hyper center of the marker with the largest T
        circles = fit_circles(np.moveaxis(p, 1, 0))
        best = int(np.argmax(circles.conditioning)) if p.shape[1] else 0
        begin = circles.center[best] if p.shape[1] and circles.valid[best] else None
    else:
        begin = np.asarray(start, dtype=np.float64)
    if seen.sum() < 2 + p.shape[1] + 1 or begin is None:
        reason = (
            "no marker path is an arc (too few frames, no motion or a line): "
            "increase the range of motion"
        )
        middle = p[seen].mean(axis=0) if seen.any() else np.zeros(2)
        return refused_circle(METHOD, middle, frames, reason)

    x = np.where(seen[..., None], p, 0.0)
    c, weights = _descend(x, seen, begin, robust=robust)
    return _accept_estimate(x, seen, c, weights, limits or CircleLimits())


def _descend(x: Array, seen: NDArray[np.bool_], c: Array, *, robust: bool) -> tuple[Array, Array]:
    """Return the center and the Huber weights of the points, shape (n, k)."""
    weights: Array = seen.astype(np.float64)
    mu = 1e-3
    for _ in range(_PASSES):
        e, J = radial_residuals(x, c, weights)
        if robust:
            scale = max(1.4826 * float(np.median(np.abs(e[seen]))), _LEAST_SCALE_M)
            huber = np.minimum(1.0, HUBER * scale / np.maximum(np.abs(e), 1e-12))
            weights = np.where(seen, huber, 0.0)
            e, J = radial_residuals(x, c, weights)

        H = np.einsum("tk,tka,tkb->ab", weights, J, J)
        g = np.einsum("tk,tka,tk->a", weights, J, e)
        cost = float((weights * e**2).sum())

        for _ in range(12):
            step = -np.linalg.solve(H + mu * np.diag(np.diag(H)) + 1e-15 * np.eye(2), g)
            tried, _ = radial_residuals(x, c + step, weights)
            if float((weights * tried**2).sum()) <= cost:
                break
            mu *= 5.0
        else:
            break

        c, mu = c + step, max(0.2 * mu, 1e-12)
        if float(np.linalg.norm(step)) < 1e-10:
            break

    return c, weights


def _accept_estimate(
    x: Array, seen: NDArray[np.bool_], c: Array, w: Array, limits: CircleLimits
) -> CenterEstimate:
    e, J = radial_residuals(x, c, w)
    count = int(seen.sum())
    free = 2 + x.shape[1]

    # Huber's formula of the variance: the mean squared influence, divided by the square of the
    # fraction of points within the Huber bound.
    pull = float((w**2 * e**2)[seen].sum()) / max(count - free, 1)
    variance = pull / max(float((w[seen] >= 1.0).mean()), 0.1) ** 2
    information = np.einsum("tk,tka,tkb->ab", seen.astype(np.float64), J, J)

    # Noise also changes the directions from the center to the points. The contribution of this
    # change to H is not information and is subtracted.
    u2 = np.maximum(((x - c) ** 2).sum(axis=-1), 1e-6)
    across = np.eye(2) * float((seen / u2).sum()) - np.einsum(
        "tk,tka,tkb->ab", seen / u2**2, x - c, x - c
    )
    H = information - variance * across
    frames = int(seen.any(axis=1).sum())
    least, most = np.linalg.eigvalsh(H)
    if not least > ROUNDING * most:
        reason = "noise hides the curvature: increase the range of motion or bring cameras closer"
        return refused_circle(METHOD, c, frames, reason)

    wider = variance_inflation(lag_one_correlation(e, seen))
    C = np.asarray(wider * variance * np.linalg.inv(H))
    distance = np.linalg.norm(x - c, axis=-1)
    R = np.array([float(distance[s, k].mean()) if s.any() else 0.0 for k, s in enumerate(seen.T)])
    radius = float(np.median(R[R > 0.0]))
    largest = float(np.linalg.eigvalsh(C)[-1])
    T = radius / sqrt(largest) if largest > 0.0 else inf
    shown = [arc_about(np.where(s[:, None], x[:, k], np.nan), c) for k, s in enumerate(seen.T)]
    sd = sqrt(float(np.trace(C)))

    return CenterEstimate(
        method=METHOD,
        center=c,
        covariance=C,
        noise=sqrt(variance),
        residual=float(np.sqrt((e[seen] ** 2).mean())),
        radii=R,
        arc=max(shown),
        bound=sqrt(variance * float(np.trace(np.linalg.inv(information)))),
        conditioning=T,
        frames=frames,
        effective_frames=frames / wider,
        within95=ellipse_scale(float(count), T),
        refused=objection(radius, max(shown), T, sd, limits),
    )
