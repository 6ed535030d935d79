"""Minimum-delay filter, which relates device clock and host clock from arrival times alone.

A sample with the device time u and the arrival A has the difference ``y = A - u = c + s u + D``. c
is the clock offset, s the skew, and ``D >= D_min`` a delay of unknown distribution. The filter fits
the line below all points (``mean_feasible_line``). This line depends on the fastest samples only.
Jitter of any distribution therefore causes no bias other than the constant D_min, which one-way
measurements cannot observe.

Inputs are integers. Memory is constant, and so is the time per sample, except for the periodic
refit.
"""

from __future__ import annotations

from collections import deque
from math import inf, sqrt
from typing import TYPE_CHECKING

from jointfit_daemon.timing.clock._feasible_line import mean_feasible_line

if TYPE_CHECKING:
    from jointfit_daemon.timing.clock._feasible_line import Point

BUCKET_NS = 250_000_000
"""Length of a bucket, ns. The fastest sample of each bucket is used."""
BUCKETS = 240
"""Number of buckets. They span one minute, which is long compared with jitter and short compared
with the thermal drift of a crystal.
"""
YOUNG_NS = 10_000_000_000
"""Span of the points below which each bucket triggers a refit, ns. With a larger span the line is
refitted every four seconds.
"""
SETTLED_NS = 2_000_000_000
"""Least span of a settled line, ns."""
SETTLED_POINTS = 10
"""Least number of buckets of a settled line."""
TRUSTED_NS = 500_000.0
"""Standard deviation below which the line counts as settled, ns."""
FLOOR_NS = 10_000.0
"""Least standard deviation of the line, ns."""
CRYSTAL = 50e-6
"""Prior standard deviation of the skew of a crystal clock, dimensionless."""
NOMINAL_RATE = 5000e-6
"""Prior standard deviation of a sample rate relative to its nominal value."""

_OLD_REFIT_BUCKETS = 16
"""Number of buckets between two refits of a settled line with a span above ``YOUNG_NS``."""
_FLOOR_VAR = FLOOR_NS**2
_LINE_POINTS = 3
"""Least number of points for a line with a standard deviation."""


class MinimumDelayFilter:
    """Line below a stream of points (u, y).

    With a short span or few points the slope stays near its prior.

    Parameters
    ----------
    skew_sd : float
        Prior standard deviation of the slope, dimensionless; its mean is 0.
    """

    __slots__ = (
        "_best", "_best_key", "_bucket_end", "_c", "_points", "_prior", "_prior_sd", "_ref",
        "_sealed", "_span", "_variance", "_y0", "settled", "skew",
    )  # fmt: skip

    def __init__(self, skew_sd: float = CRYSTAL) -> None:
        self.skew = 0.0
        """Slope s, dimensionless; positive when the device clock runs slow."""
        self.settled = False
        """Whether the line has enough points, span and precision."""
        self._prior, self._prior_sd = 0.0, skew_sd
        self._points: deque[Point] = deque(maxlen=BUCKETS)
        self._best: Point | None = None
        self._best_key = inf
        self._bucket_end = self._ref = self._y0 = self._sealed = self._span = 0
        self._c = 0.0
        self._variance = (inf, 0.0, skew_sd**2)

    @property
    def skew_sigma(self) -> float:
        """Standard deviation of ``skew``."""
        return sqrt(self._variance[2])

    def residual(self, u: int, y: int) -> float:
        """Return the height of (u, y) above the line, ns; 0 before the first point."""
        if self._best is None:
            return 0.0
        return y - self._y0 - self._c - self.skew * (u - self._ref)

    def offset_ns(self, u: int) -> int:
        """Return the value of the line at `u`, ns: the clock offset plus D_min."""
        return self.at(u)[0]

    def sigma_ns(self, u: int) -> float:
        """Return the standard deviation of the line at `u`, ns; inf before the third bucket."""
        return self.at(u)[1]

    def at(self, u: int) -> tuple[int, float]:
        """Return ``offset_ns`` and ``sigma_ns`` in one call, to save time for every sample."""
        ahead = u - self._ref
        height, both, slope = self._variance
        spread = height + ahead * (2.0 * both + ahead * slope)
        sigma = sqrt(_FLOOR_VAR + spread) if spread > 0.0 else FLOOR_NS
        return self._y0 + round(self._c + self.skew * ahead), sigma

    def feed(self, u: int, y: int) -> float:
        """Add a point with increasing `u`; return the height of the point above the line, ns.

        A point below the line lowers the line immediately, because no sample arrives before it was
        sent.
        """
        if self._best is None:
            self._y0, self._ref, self._bucket_end = y, u, u + BUCKET_NS
            self._best, self._best_key = (u, 0), 0.0
            return 0.0
        y -= self._y0

        key = y - self.skew * (u - self._ref)
        residual = key - self._c
        if u >= self._bucket_end:
            self._seal(u, y)
        elif key < self._best_key:
            self._best, self._best_key = (u, y), key
        if residual < 0.0:
            self._c = min(self._c, y - self.skew * (u - self._ref))
        return residual

    def _seal(self, u: int, y: int) -> None:
        points = self._points
        if self._best is not None:
            points.append(self._best)
        oldest = u - BUCKETS * BUCKET_NS
        while points and points[0][0] < oldest:
            points.popleft()
        self._span = u - points[0][0] if points else 0

        enough = len(points) >= SETTLED_POINTS and self._span >= SETTLED_NS

        self._sealed += 1
        if not points:  # after a silence longer than the window the last slope becomes the prior
            self._prior, self._prior_sd = self.skew, CRYSTAL / 10
            self._c, self._ref = float(y), u
            self._variance = (inf, 0.0, self._prior_sd**2)
        elif self._span < YOUNG_NS or not self.settled or self._sealed % _OLD_REFIT_BUCKETS == 0:
            if len(points) < _LINE_POINTS:
                self._c += self.skew * (u - self._ref)
            else:
                line = mean_feasible_line(points, u, self._prior, self._prior_sd)
                self._c, self.skew = line.height, line.slope
                self._variance = (line.height_var, line.both, line.slope_var)
            self._ref = u

        self.settled = enough and (self.settled or self.sigma_ns(u) <= TRUSTED_NS)
        self._best, self._best_key = (u, y), y - self.skew * (u - self._ref)
        self._bucket_end = u + BUCKET_NS
