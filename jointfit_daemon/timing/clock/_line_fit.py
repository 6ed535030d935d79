"""Robust weighted fit of a straight line.

The method is weighted least squares with Huber weights. A zero-mean normal prior on the slope keeps
the slope small while the data span is short.
"""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence

_HUBER = 1.345
"""Huber threshold in standard deviations. The fit is then 95 % efficient for normal errors."""
_PASSES = 4
"""Number of iterations of the reweighted least squares."""


class FittedLine(NamedTuple):
    """Line ``y = height + slope x`` with its covariance."""

    height: float
    slope: float
    height_var: float
    both: float
    """Covariance of height and slope."""
    slope_var: float

    def variance_at(self, x: float) -> float:
        """Return the variance of the line at `x`."""
        return max(0.0, self.height_var + x * (2.0 * self.both + x * self.slope_var))


def fit_line(rows: Sequence[tuple[float, float, float]], slope_sd: float) -> FittedLine:
    """Return the line through `rows`, each (x, y, 1/variance of y).

    Parameters
    ----------
    rows : sequence of (float, float, float)
        At least one row.
    slope_sd : float
        Prior standard deviation of the slope; its mean is 0.
    """
    height, slope = rows[0][1], 0.0
    height_var = both = slope_var = 0.0
    for number in range(_PASSES):
        a = b = d = p = q = 0.0

        for x, y, weight in rows:
            residual = abs(y - height - slope * x) * sqrt(weight)
            w = weight if number == 0 or residual <= _HUBER else weight * _HUBER / residual
            a, b, d = a + w, b + w * x, d + w * x * x
            p, q = p + w * y, q + w * x * y

        # Add the normal equations of the slope prior, whose mean is 0.
        d += 1.0 / slope_sd**2
        det = a * d - b * b
        height, slope = (d * p - b * q) / det, (a * q - b * p) / det
        height_var, both, slope_var = d / det, -b / det, a / det
    return FittedLine(height, slope, height_var, both, slope_var)
