"""Range of motion, differences between two measurements of an angle, and gaps of a series."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.session_data import interpolate_values, sample_rate_hz

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.session_data import JointSeries

QUANTILE_95 = 1.959963984540054
"""Half width of the 95 % interval of a normal distribution, in standard deviations."""
_LEAST_GAP_S = 0.05
"""Shortest interval without samples that counts as a gap, s. A delay of some samples is not a gap.
"""
_LEAST_GAP_PERIODS = 3.0
"""Shortest interval without samples that counts as a gap, in sample periods. The longer of the two
limits applies."""


@dataclass(frozen=True, slots=True)
class MotionRange:
    """Range of a joint angle over a session, rad."""

    joint: str
    angle: str
    minimum: float
    maximum: float
    median: float
    low: float
    """Quantile 0.025 of the values."""
    high: float
    """Quantile 0.975 of the values."""
    minimum_sd: float
    """Standard deviation at the minimum; NaN if unknown."""
    maximum_sd: float
    """Standard deviation at the maximum; NaN if unknown."""
    known_share: float
    """Fraction of the instants at which the angle is known."""

    @property
    def extent(self) -> float:
        """Maximum minus minimum, rad."""
        return self.maximum - self.minimum

    @property
    def extent_sd(self) -> float:
        """Standard deviation of `extent` for independent errors of minimum and maximum, rad."""
        return float(np.hypot(self.minimum_sd, self.maximum_sd))


def motion_range(joint: JointSeries, angle: str) -> MotionRange | None:
    """Return the range of an angle; None if the angle is unknown at all instants."""
    values = joint.angles[angle]
    known = np.isfinite(values)
    if not known.any():
        return None

    lowest, highest = int(np.nanargmin(values)), int(np.nanargmax(values))
    low, median, high = np.quantile(values[known], [0.025, 0.5, 0.975])
    sd = joint.angle_sd.get(angle, np.full(len(values), np.nan))
    return MotionRange(
        joint.name, angle, float(values[lowest]), float(values[highest]), float(median), float(low),
        float(high), float(sd[lowest]), float(sd[highest]), float(known.mean()),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class AngleDifference:
    """Difference between the sensor and camera values of an angle (Bland and Altman 1986)."""

    joint: str
    angle: str
    t_s: Array
    """Instants of camera frames at which both angles are known, s, shape (n,)."""
    difference: Array
    """Sensor angle minus camera angle, wrapped to ±π, rad, shape (n,)."""
    mean: Array
    """Mean of sensor angle and camera angle, rad, shape (n,)."""
    bias: float
    """Mean of `difference`, rad."""
    sd: float
    """Standard deviation of `difference`, rad."""
    rms: float
    """Root of the mean square of `difference`, rad."""
    worst: float
    """Largest absolute difference, rad."""
    coverage: float
    """Fraction of `difference` within the 95 % interval that the standard deviation of the sensor
    angle predicts; NaN if this standard deviation is unknown.
    """

    @property
    def limits(self) -> tuple[float, float]:
        """Limits of agreement, rad, which contain 95 % of normally distributed differences."""
        return self.bias - QUANTILE_95 * self.sd, self.bias + QUANTILE_95 * self.sd


def angle_difference(
    sensors: JointSeries, cameras: JointSeries, angle: str
) -> AngleDifference | None:
    """Compare an angle at the instants of camera frames; return None without common instants."""
    own = interpolate_values(sensors.t_s, sensors.angles[angle], cameras.t_s)
    reference = cameras.angles[angle]
    difference = np.mod(own - reference + np.pi, 2.0 * np.pi) - np.pi
    known = np.isfinite(difference)
    if not known.any():
        return None

    coverage = float("nan")
    if angle in sensors.angle_sd:
        sd = interpolate_values(sensors.t_s, sensors.angle_sd[angle], cameras.t_s)
        stated = known & np.isfinite(sd)
        if stated.any():
            coverage = float((np.abs(difference) <= QUANTILE_95 * sd)[stated].mean())

    kept = difference[known]
    return AngleDifference(
        joint=sensors.name,
        angle=angle,
        t_s=cameras.t_s[known],
        difference=kept,
        mean=reference[known] + 0.5 * kept,
        bias=float(kept.mean()),
        sd=float(kept.std()),
        rms=float(np.sqrt(np.mean(kept**2))),
        worst=float(np.abs(kept).max()),
        coverage=coverage,
    )


@dataclass(frozen=True, slots=True, eq=False)
class SeriesQuality:
    """Rate and completeness of a series."""

    count: int
    rate_hz: float
    """Rate, Hz, the inverse of the median interval; NaN for fewer than two rows."""
    lost_share: float
    """Missing samples as a fraction of the samples expected between the first and the last row."""
    gaps_s: Array
    """Start and end of each interval without samples, s, shape (n, 2)."""


def series_quality(t_s: Array, known: NDArray[np.bool_] | None = None) -> SeriesQuality:
    """Return rate, loss and gaps of the rows of a series.

    Parameters
    ----------
    t_s : ndarray, shape (n,)
        Instants of the rows, s.
    known : ndarray, shape (n,), optional
        Mask of the rows to count; by default all rows.
    """
    rate_hz = sample_rate_hz(t_s)
    kept = t_s if known is None else t_s[known]
    if len(kept) < 2:  # noqa: PLR2004 - an interval has two ends
        return SeriesQuality(len(kept), rate_hz, float("nan"), np.empty((0, 2)))
    expected = (kept[-1] - kept[0]) * rate_hz + 1.0
    wide = np.diff(kept) > max(_LEAST_GAP_S, _LEAST_GAP_PERIODS / rate_hz)
    gaps = np.column_stack([kept[:-1][wide], kept[1:][wide]])
    return SeriesQuality(len(kept), rate_hz, max(0.0, 1.0 - len(kept) / expected), gaps)
