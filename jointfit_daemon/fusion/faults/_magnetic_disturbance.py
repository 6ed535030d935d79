r"""Detection and correction of magnetic disturbances, which change headings within seconds.

A ferromagnetic object near a sensor with magnetometer changes the heading of the sensor within
seconds. The heading returns when the object is removed. Heading differences are measured in pairs
of sensors on one segment and across a hinge. The heading :math:`h_i` of each sensor relative to the
first sensor is a sum of these differences. The deviation of this heading from the weighted median
is corrected; every segment has the same weight:

.. math:: o_i = h_i - \mathrm{median}(h), \qquad
          \text{correction: } o_i \cdot \mathrm{clip}\bigl((|o_i| - s_0) / (s_1 - s_0), 0, 1\bigr)

Here :math:`s_0` and :math:`s_1` are ``CORRECTION_START`` and ``CORRECTION_FULL``, multiplied by the
standard deviation of a difference without disturbance. If one of four sensors is disturbed, it is
identified and corrected, and the others are unchanged. If two halves of the sensors contradict each
other, the median is an interval. Deviations are then measured from the middle of the interval,
which preserves joint angles. Half the width of the interval is the uncertainty of all headings.

Only differences are observable, so a disturbance that rotates all sensors equally is not detected.
"""

from __future__ import annotations

from collections import Counter
from math import exp
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

SMOOTHING_S = 0.4
"""Time constant of the measured differences, s."""
CORRECTION_S = 0.25
"""Time constant with which corrections approach their targets, s, so that the output does not jump.
"""
STALE_NS = 500_000_000
"""Longest time between two measurements of a smoothed difference, ns. After a longer time the
difference restarts from 0.
"""
CORRECTION_START = 1.6
"""Deviation from the median at which the correction starts, in standard deviations."""
CORRECTION_FULL = 3.2
"""Deviation above which the correction is complete, in standard deviations."""
NEGLIGIBLE = 0.002
"""Angle below which the correction of a disturbance that has ended is removed, rad."""
MIN_SD = 0.026
"""Smallest standard deviation of a difference, rad. It is 1.5 degrees."""


class HeadingDifference(NamedTuple):
    """Heading of sensor `b` relative to sensor `a`, without the effects of posture and drift."""

    a: str
    b: str
    angle: float
    """Measured heading difference, rad."""
    sd: float
    """Standard deviation of a difference without disturbance, rad."""


class _SmoothedDifference:
    __slots__ = ("angle", "before_ns", "sd")

    def __init__(self) -> None:
        self.angle, self.sd = 0.0, MIN_SD
        self.before_ns: int | None = None

    def update(self, t_ns: int, angle: float, sd: float) -> None:
        if self.before_ns is None or t_ns - self.before_ns > STALE_NS:
            self.angle, self.before_ns = 0.0, t_ns
        gain = 1.0 - exp(-(t_ns - self.before_ns) * 1e-9 / SMOOTHING_S)
        self.angle += gain * (angle - self.angle)
        self.sd, self.before_ns = sd, t_ns


class MagneticDisturbanceDetector:
    """Estimates heading corrections for the sensors of one limb.

    Parameters
    ----------
    groups : sequence of sequence of str
        Sensor ids by segment.
    """

    def __init__(self, groups: Sequence[Sequence[str]]) -> None:
        self._segment = {name: i for i, group in enumerate(groups) for name in group}
        self._differences: dict[tuple[str, str], _SmoothedDifference] = {}
        self.corrections: dict[str, float] = {}
        """Angle to subtract from the heading of each sensor, rad; sensors without a correction are
        absent.
        """
        self.ambiguity = 0.0
        """Standard deviation that a disturbance adds to all headings, rad. It is largest if two
        halves of the sensors contradict each other.
        """
        self._before_ns: int | None = None
        self._deviations: dict[str, float] = {}
        """Deviations of sensors from the median, rad; empty while all differences are small."""

    def update(self, t_ns: int, differences: Iterable[HeadingDifference]) -> bool:
        """Add the differences of one frame; return whether the corrections changed.

        Parameters
        ----------
        t_ns : int
            Instant of the frame.
        differences : iterable of HeadingDifference
            Differences within segments and across hinges. The differences must form a forest, a
            graph with at most one path between two sensors.
        """
        edges = []
        total, max_sd = 0.0, MIN_SD
        for a, b, angle, sd in differences:
            smoothed = self._differences.get((a, b))
            if smoothed is None:
                smoothed = self._differences[a, b] = _SmoothedDifference()
            smoothed.update(t_ns, angle, sd)
            total, max_sd = total + abs(smoothed.angle), max(max_sd, sd)
            edges.append((a, b, smoothed))

        targets: dict[str, float] = {}
        self._deviations, ambiguity = {}, 0.0
        if total > CORRECTION_START * max_sd:  # no deviation can exceed the sum of the differences
            targets, ambiguity = self._target_corrections(edges)
        return self._follow(t_ns, targets, ambiguity)

    def outlier(self, a: str, b: str) -> tuple[str, float] | None:
        """Return the disturbed sensor of a pair and its deviation, rad, or None.

        The sensor with the larger deviation counts as disturbed if it is corrected, and if the
        deviation of the other sensor is less than half as large.
        """
        deviations = self._deviations
        larger = abs(deviations.get(a, 0.0)) > abs(deviations.get(b, 0.0))
        name, other = (a, b) if larger else (b, a)
        deviation, near = deviations.get(name, 0.0), deviations.get(other, 0.0)
        agrees = abs(near) < 0.5 * abs(deviation)
        return (name, deviation) if name in self.corrections and agrees else None

    def _follow(self, t_ns: int, targets: Mapping[str, float], ambiguity: float) -> bool:
        """Move the corrections towards their targets without a jump.

        The result is False if there are neither corrections nor targets.
        """
        gain = 1.0 - exp(-(t_ns - (self._before_ns or t_ns)) * 1e-9 / CORRECTION_S)
        self._before_ns = t_ns
        if not targets and not self.corrections:
            self.ambiguity = 0.0
            return False

        corrections = {}
        for name in {**self.corrections, **targets}:
            before = self.corrections.get(name, 0.0)
            angle = before + gain * (targets.get(name, 0.0) - before)
            if name in targets or abs(angle) > NEGLIGIBLE:
                corrections[name] = angle
        self.corrections = corrections
        self.ambiguity += gain * (ambiguity - self.ambiguity)
        return True

    def _target_corrections(
        self, edges: list[tuple[str, str, _SmoothedDifference]]
    ) -> tuple[dict[str, float], float]:
        targets, ambiguity = {}, 0.0
        for headings, sd in _connected_headings(edges):
            # Every segment has the same weight, which is divided among its sensors.
            sizes = Counter(self._segment[name] for name in headings)
            if len(sizes) < 2:  # noqa: PLR2004 - no joint
                continue
            weighted = [(h, 1.0 / sizes[self._segment[name]]) for name, h in headings.items()]

            low, high = _weighted_median(weighted)
            middle = 0.5 * (low + high)
            for name, heading in headings.items():
                self._deviations[name] = heading - middle
                correction = _ramp(heading - middle, sd)
                if correction:
                    targets[name] = correction
                    # The object that disturbs this sensor may also disturb the other sensors, by
                    # angles that are too small to be observed.
                    ambiguity = max(ambiguity, min(abs(correction), sd))
            ambiguity = max(ambiguity, _ramp(0.5 * (high - low), sd))
        return targets, ambiguity


def _connected_headings(
    edges: list[tuple[str, str, _SmoothedDifference]],
) -> list[tuple[dict[str, float], float]]:
    """Return the headings and the largest standard deviation of each connected set of sensors.

    The first sensor of each set has the heading 0.
    """
    found: list[tuple[dict[str, float], float]] = []
    left = edges
    while left:
        headings, sd, before = {left[0][0]: 0.0}, MIN_SD, -1
        while len(headings) != before:
            before, rest = len(headings), []
            for edge in left:
                a, b, smoothed = edge
                if a in headings:
                    headings[b] = headings[a] + smoothed.angle
                elif b in headings:
                    headings[a] = headings[b] - smoothed.angle
                else:
                    rest.append(edge)
                    continue
                sd = max(sd, smoothed.sd)
            left = rest
        found.append((headings, sd))
    return found


def _weighted_median(weighted: list[tuple[float, float]]) -> tuple[float, float]:
    """Return the lowest and highest value that have half of the weight on either side."""
    weighted = sorted(weighted)
    half = 0.5 * sum(weight for _, weight in weighted)
    below = 0.0
    for k, (value, weight) in enumerate(weighted):
        below += weight
        if below > half + 1e-9:
            return value, value
        if below > half - 1e-9:
            return value, weighted[k + 1][0]
    return weighted[-1][0], weighted[-1][0]


def _ramp(angle: float, sd: float) -> float:
    """Return the part of a deviation that is corrected, rad.

    It is 0 for a small deviation and the whole deviation for a large one.
    """
    share = (abs(angle) / sd - CORRECTION_START) / (CORRECTION_FULL - CORRECTION_START)
    return angle * min(max(share, 0.0), 1.0)
