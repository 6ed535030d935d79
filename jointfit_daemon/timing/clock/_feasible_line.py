"""Line below a set of points with one-sided errors: posterior mean and covariance.

For points ``y = c + s u + D`` with delays D >= 0, a line (c, s) is *feasible* if no point lies
below it. Just above the line of the minimum delay, the number G of points per nanosecond of height
is nearly constant, for every shape of the delay distribution. The likelihood of a feasible line is
then ``exp(G (c + s mean(u)))``. The maximum of the likelihood is the edge of the lower convex hull
that straddles the mean of u (Moon, Skelly, Towsley, INFOCOM 1999; Zhang, Liu, Xia, INFOCOM 2002).

The posterior mean under a normal prior on s has a smaller error than the maximum, and it has a
covariance. For a given s, the largest feasible c is ``h(s) = min(y - s u)``. Below this value c is
distributed exponentially, with mean ``h(s) - 1/G``. The integral over s is evaluated numerically.

Coordinates are integers, so the hull is exact.
"""

from __future__ import annotations

from itertools import pairwise
from math import exp, log
from typing import TYPE_CHECKING

from jointfit_daemon.timing.clock._line_fit import FittedLine

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

Point = tuple[int, int]
"""Device time u and difference y, ns."""

_SUPPORTS = 2
"""Number of points at the ends of an edge of the hull."""
_FINEST_NS = 1_000.0
"""Lower bound of the mean height of the points above the edge, ns."""
_JAM_NS = 25_000_000.0
"""Height above which a point is attributed to a starved host or a full queue, ns."""
_LEAST = 5
"""Smallest number of points below ``_JAM_NS`` for which higher points are excluded."""
_LEAP = 20.0
"""Ratio of two consecutive heights in ascending order that separates congestion from jitter."""
_LEAP_NS = 3_000_000.0
"""Least height of a point that is excluded by this ratio, ns."""
_LEAP_LEAST = 4
"""Least number of points below the gap between the two heights. With this number, jitter alone
produces such a gap once in 400 cases."""
_LIKELY = 1e-3
"""Largest plausible slope of a clock whose declared tick rate is correct, dimensionless."""
_TAIL = 14.0
"""Decrease of the log-likelihood at which the integral is cut off."""
_PRIOR_TAIL = 6.0
"""Distance from the prior mean at which the integral is cut off, standard deviations."""
_WILDEST = 5e-3
"""Largest slope of any clock, dimensionless."""
_STEPS = 20
"""Number of intervals of the slope grid."""
_PASSES = 3
"""Number of successive slope grids, each finer than the grid before."""


def lower_hull(points: Iterable[Point]) -> list[Point]:
    """Return the lower convex hull from left to right (Andrew's monotone chain, exact)."""
    hull: list[Point] = []
    for u, y in sorted(points):
        while len(hull) > 1:
            (u0, y0), (u1, y1) = hull[-2], hull[-1]
            if (u1 - u0) * (y - y0) > (y1 - y0) * (u - u0):
                break
            hull.pop()
        if hull and hull[-1][0] == u:  # sorting placed the lowest point with this u first
            continue
        hull.append((u, y))
    return hull


def straddling_edge(hull: Sequence[Point], mean_u: float) -> tuple[Point, Point]:
    """Return the edge of `hull` (two points or more) that spans `mean_u`."""
    for left, right in pairwise(hull):
        if mean_u <= right[0]:
            return left, right
    return hull[-2], hull[-1]


def mean_feasible_line(
    points: Sequence[Point], ref: int, prior: float, prior_sd: float
) -> FittedLine:
    """Return the posterior mean of the lines below `points`, with its covariance.

    Parameters
    ----------
    points : sequence of (int, int)
        (u, y) in ns, three or more, at different u.
    ref : int
        Value of u at which the height is returned, ns.
    prior, prior_sd : float
        Prior mean and standard deviation of the slope.
    """
    hull = lower_hull(points)
    likely = max(_PRIOR_TAIL * prior_sd, _LIKELY)
    on_time = _on_time(points, hull, prior - likely, prior + likely)
    if len(on_time) < len(points):
        points, hull = on_time, lower_hull(on_time)

    mean_u = sum(at for at, _ in points) / len(points)
    (ua, ya), (ub, yb) = straddling_edge(hull, mean_u)
    # The slope is limited, because samples that were read at the same arrival A (y = A - u) form an
    # edge with the slope -1.
    most = max(_PRIOR_TAIL * prior_sd, _WILDEST)
    edge = min(max((yb - ya) / (ub - ua), prior - most), prior + most)

    # Scale of the posterior, 1/G, from the heights above the edge. The median height is log(2)
    # times the mean height. The two points that define the edge contain no information, and the
    # mean reduces the degrees of freedom by one.
    heights = sorted(y - ya - edge * (at - ua) for at, y in points)
    count = len(heights)
    median = heights[(count + _SUPPORTS) // 2] - heights[0]
    scale = max(median / log(2.0), _FINEST_NS) / max(1, count - _SUPPORTS - 1)

    # Range of slopes with relevant weight, limited by the prior.
    rows = [(float(at - ref), float(y - ya)) for at, y in hull]
    middle, least = mean_u - ref, (hull[-1][0] - hull[0][0]) / 100
    low = edge - _TAIL * scale / max(mean_u - ua, least)
    high = edge + _TAIL * scale / max(ub - mean_u, least)
    near, far = prior - _PRIOR_TAIL * prior_sd, prior + _PRIOR_TAIL * prior_sd
    if low < far and near < high:
        low, high = max(low, near), min(high, far)

    grid = _weigh_slopes(rows, middle, scale, (low, high), (prior, prior_sd))
    total = sum([w for _, _, w in grid])
    slope = sum([w * s for s, _, w in grid]) / total
    height = sum([w * h for _, h, w in grid]) / total
    slope_var = sum([w * (s - slope) ** 2 for s, _, w in grid]) / total
    both = sum([w * (s - slope) * (h - height) for s, h, w in grid]) / total
    height_var = sum([w * (h - height) ** 2 for _, h, w in grid]) / total

    return FittedLine(float(ya) + height - scale, slope, height_var + scale**2, both, slope_var)


def _on_time(
    points: Sequence[Point], hull: Sequence[Point], near: float, far: float
) -> Sequence[Point]:
    """Return the points that were not delayed by congestion.

    Heights are measured above the hull. An outer edge of the hull ends at a delayed point if the
    slope of the edge is outside the likely range from `near` to `far`. Such an edge is replaced by
    an edge with the slope `near` on the left or `far` on the right.
    """
    u0, tilt = points[0][0], _slope(points[0], points[-1])
    rests = [y - tilt * (u - u0) for u, y in points]
    if max(rests) - min(rests) < _LEAP_NS:  # the usual case: no point is congested
        return points
    first, last = 0, len(hull) - 1
    while first < last and _slope(hull[first], hull[first + 1]) < near:
        first += 1
    while first < last and _slope(hull[last - 1], hull[last]) > far:
        last -= 1

    supports = hull[first : last + 1]
    heights = [_height(point, supports, near, far) for point in points]

    ranked = sorted(heights)
    for k in range(_LEAP_LEAST, len(ranked)):
        leaps = ranked[k] > max(_LEAP_NS, _LEAP * ranked[k - 1])
        if leaps or (ranked[k] >= _JAM_NS and k >= _LEAST):
            return [p for p, h in zip(points, heights, strict=True) if h < ranked[k]]
    return points


def _slope(left: Point, right: Point) -> float:
    return (right[1] - left[1]) / (right[0] - left[0])


def _height(point: Point, supports: Sequence[Point], near: float, far: float) -> float:
    """Return the height of a point above the chain of `supports`, ns."""
    u, y = point
    if u <= supports[0][0]:
        return y - supports[0][1] - near * (u - supports[0][0])
    for left, right in pairwise(supports):
        if u <= right[0]:
            return y - left[1] - _slope(left, right) * (u - left[0])
    return y - supports[-1][1] - far * (u - supports[-1][0])


def _weigh_slopes(
    rows: list[tuple[float, float]],
    middle: float,
    scale: float,
    limits: tuple[float, float],
    prior: tuple[float, float],
) -> list[tuple[float, float, float]]:
    """Return (slope, greatest feasible height, weight) for each slope of a grid."""
    low, high = limits
    mean, sd = prior
    grid: list[tuple[float, float, float]] = []
    top = 0.0
    for _ in range(_PASSES):
        step = (high - low) / _STEPS
        grid = []
        for k in range(_STEPS + 1):
            s = low + k * step
            height = min([y - s * u for u, y in rows])
            grid.append((s, height, (height + s * middle) / scale - 0.5 * ((s - mean) / sd) ** 2))

        top = max([row[2] for row in grid])
        kept = [k for k, row in enumerate(grid) if row[2] > top - _TAIL]
        low, high = grid[max(0, kept[0] - 1)][0], grid[min(_STEPS, kept[-1] + 1)][0]
    return [(s, height, exp(weight - top)) for s, height, weight in grid]
