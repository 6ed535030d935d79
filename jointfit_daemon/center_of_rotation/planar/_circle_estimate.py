"""Center estimates from the moments of points on a circle.

An estimate contains the covariance and the Cramér-Rao bound. An estimate outside the acceptance
limits is refused, with cause and remedy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import degrees, inf, isfinite, pi, radians, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation._path_statistics import arc_of_spread, variance_inflation
from jointfit_daemon.center_of_rotation._result import CenterEstimate, refusal
from jointfit_daemon.center_of_rotation.planar._circle_fit import CircleMethod, circle_of, temper
from jointfit_daemon.center_of_rotation.planar._moments import (
    GATE,
    ROUNDING,
    CircleMoments,
    arc_shows,
    circle_statistics,
    ellipse_scale,
    moments_of_one,
    noise_of,
    seen_places,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array


STILL_M = 0.001
"""RMS distance from the mean, m, below which all points count as one position."""


@dataclass(frozen=True, slots=True)
class CircleLimits:
    """Acceptance limits of a planar center."""

    gate: float = GATE
    """Smallest accepted T, the radius divided by the largest standard error of the center."""
    reach: tuple[float, float] = (0.02, 1.0)
    """Smallest and largest accepted distance of a marker from the center, m."""
    arc: float = radians(10.0)
    """Smallest arc of the movement, rad."""
    rms_error: float = inf
    """Largest accepted predicted RMS error, m. If noise increases the curvature of the arc by
    chance, the center is biased and the predicted error is too small. A limit near the expected
    error therefore selects biased centers, whose error ellipses often miss the true center.
    """


def circle_estimate(
    points: ArrayLike,
    weights: ArrayLike | None = None,
    *,
    method: CircleMethod = "hyper",
    limits: CircleLimits | None = None,
) -> CenterEstimate:
    """Estimate the center of rotation of one marker from all frames at once.

    Parameters
    ----------
    points : array_like, shape (n, 2)
        Positions in the parent's coordinates, in order of time, m; NaN where missing.
    weights : array_like, shape (n,), optional
        Weight of each point, not negative; 1 by default.
    method : str
        ``kasa``, ``pratt``, ``taubin`` or ``hyper``.
    limits : CircleLimits, optional
        Acceptance limits.

    Returns
    -------
    CenterEstimate
        Estimate. Except for rounding it equals the estimate of a `RunningCircle` that processed the
        same points.
    """
    p = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    seen = seen_places(p)
    w = np.where(seen, 1.0 if weights is None else np.asarray(weights, dtype=np.float64), 0.0)
    x = p if seen.all() else np.where(seen[:, None], p, 0.0)
    empty = CircleMoments(*(0.0,) * 10)
    m = moments_of_one(x, w) if w.any() else empty

    def lagged_product(a: float, b: float, square: float) -> float:
        d = x - np.array([m.x + a, m.y + b])
        e = np.einsum("nc,nc->n", d, d) - square
        pair = w[1:] * w[:-1]
        return float((pair * e[1:]) @ e[:-1] / (4.0 * square * max(float(pair.sum()), 1e-300)))

    return publish(
        m, lagged_product, method=method, frames=int(seen.sum()), limits=limits or CircleLimits()
    )


def publish(
    m: CircleMoments[float],
    lagged_product: Callable[[float, float, float], float],
    *,
    method: CircleMethod,
    frames: int,
    limits: CircleLimits,
) -> CenterEstimate:
    """Fit a circle and return the estimate of its center, which may be refused.

    Parameters
    ----------
    m : CircleMoments
        Moments of the points.
    lagged_product : callable
        Function of a center (a, b), relative to the centroid, and R². It returns the mean product
        of the radial residuals of successive frames, m², from which the correlation of these
        residuals is computed.
    method : str
        Name of the circle fit.
    frames : int
        Number of available points.
    limits : CircleLimits
        Acceptance limits.
    """
    reason = _reason_without_circle(m, frames)
    if reason is not None:
        return refused_circle(method, (m.x, m.y), frames, reason)
    circle = circle_of(m, method)
    if circle is None or not arc_shows(m, noise_of(m, *circle)[0]):
        reason = "noise hides the curvature: increase the range of motion or bring cameras closer"
        return refused_circle(method, (m.x, m.y), frames, reason)

    # Correlation between the noise of successive frames reduces the effective number of frames.
    statistics = circle_statistics(m, *circle)
    alike = lagged_product(*circle) / statistics.residual if statistics.residual > 0.0 else 0.0
    wider = variance_inflation(min(max(alike, 0.0), 0.99) if isfinite(alike) else 0.0)

    a, b, square = circle
    cov = (wider * statistics.xx, wider * statistics.xy, wider * statistics.yy)
    largest = wider * statistics.largest
    T = sqrt(square / largest) if largest > 0.0 else inf
    a, b, cov = temper(a, b, square, cov)
    radius, arc = sqrt(square), arc_of_spread((m.xx + m.yy - 2.0 * statistics.noise) / square)
    effective = m.effective / wider
    sd = sqrt(max(cov[0] + cov[2], 0.0))

    return CenterEstimate(
        method=method,
        center=np.array([m.x + a, m.y + b]),
        covariance=np.array([[cov[0], cov[1]], [cov[1], cov[2]]]),
        noise=sqrt(statistics.noise),
        residual=sqrt(statistics.residual),
        radii=np.array([radius]),
        arc=arc,
        bound=sqrt(statistics.bound),
        conditioning=T,
        frames=frames,
        effective_frames=effective,
        within95=ellipse_scale(m.effective, T),
        refused=objection(radius, arc, T, sd, limits),
    )


def objection(radius: float, arc: float, T: float, sd: float, limits: CircleLimits) -> str | None:
    """Return the reason to reject a circle, with the remedy; None if the circle is usable."""
    if not limits.reach[0] <= radius <= limits.reach[1]:
        return (
            f"the marker would be {radius:.2f} m from the center, not {limits.reach[0]:g} to "
            f"{limits.reach[1]:g} m: check marker names or increase the range of motion"
        )

    if arc < limits.arc:
        return f"the joint turned {degrees(arc):.0f}°: move it through at least 30°"
    if limits.gate > T:
        return (
            f"ill-conditioned: the arc's curvature is {T:.1f} times its standard error, at least "
            f"{limits.gate:g} are required: increase the range of motion"
        )

    if sd > limits.rms_error:
        return (
            f"the predicted error is {1000 * sd:.0f} mm, above the limit of "
            f"{1000 * limits.rms_error:.0f} mm: "
            "move the joint further or for longer"
        )

    return None


def refused_circle(method: str, at: ArrayLike, frames: int, reason: str) -> CenterEstimate:
    """Return a refused estimate at a point, shape (2,), with every direction unobserved."""
    middle = np.asarray(at, dtype=np.float64)
    return replace(
        refusal(method, 2, frames, reason),
        center=middle if np.isfinite(middle).all() else np.zeros(2),
        noise=0.0,
        residual=0.0,
        effective_frames=float(frames),
    )


def _reason_without_circle(m: CircleMoments[float], frames: int) -> str | None:
    spread = max(m.xx + m.yy, 0.0)  # negative only by rounding
    if frames == 0:
        return "the marker is missing in every frame: check its name, the cameras and occlusion"
    if frames < 4 or m.effective <= 3.0:
        return f"{frames} usable frames, at least 4 are required: record a longer trial"
    if spread < STILL_M**2:
        return f"no motion: the marker moved {1000 * sqrt(spread):.1f} mm RMS: move the joint"
    if m.xx * m.yy - m.xy**2 <= ROUNDING * spread**2:
        return "the points lie on a straight line, which has no center: rotate the joint"
    return None


def arc_about(points: Array, center: Array) -> float:
    """Return the angle at the center between the two outermost points, rad, at most 2π.

    Points have shape (n, 2), m, with NaN where hidden, and the center has shape (2,), m.
    """
    seen = points[np.isfinite(points).all(axis=-1)] - center
    if len(seen) < 2 or not np.isfinite(center).all():
        return 0.0
    turn = np.sort(np.arctan2(seen[:, 1], seen[:, 0]))
    gaps = np.diff(turn, append=turn[0] + 2.0 * pi)
    widest = float(gaps.max())
    # on a full circle, no gap between neighboring points exceeds twice the mean gap
    return 2.0 * pi - widest if widest > 4.0 * pi / len(seen) else 2.0 * pi
