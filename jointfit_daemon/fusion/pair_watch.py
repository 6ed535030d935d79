"""Tells whether two sensors of one segment still lie to each other as calibration saw it.

Law: pure, O(1) a look. Doubt is felt at once, as a distance beyond what is usual, and told only
when it lasts; it ends when it has been well below its limit for a while.
"""

from __future__ import annotations

from math import exp, radians, sqrt
from typing import TYPE_CHECKING

from jointfit_daemon.calibration.sensor_links import SensorLink, length_one
from jointfit_daemon.kinematics.rotation_scalar import turn_one

if TYPE_CHECKING:
    from jointfit_daemon.model import Quaternion, Vector

SMOOTH_S = 0.4
LASTS_NS, ENDS_NS = 500_000_000, 2_000_000_000
LIMIT, LEAST_LIMIT = 3.0, radians(6.0)
"""Distance, smoothed, in units of its usual RMS length, from which on something slipped."""
USUAL = 1.5
"""Distance in the same units that is still no reason for doubt."""
UNTRAINED_SD = radians(5.0)
"""Per component, of pairs that no movement has been seen of."""


def untrained(a: str, b: str) -> SensorLink:
    """Return what is expected of a pair of which only the static pose is known: nothing much."""
    zero = (0.0,) * 10
    return SensorLink(a, b, "pair", (), (zero, zero, zero), zero, zero, 0.0, UNTRAINED_SD)


class PairWatch:
    """Watches one pair.

    Parameters
    ----------
    link : SensorLink
        What calibration saw of it.
    """

    def __init__(self, link: SensorLink) -> None:
        self.link = link
        self._slow: Vector = (0.0, 0.0, 0.0)
        self._usual = 0.0
        self._before_ns: int | None = None
        self._since_ns: int | None = None
        self.doubtful = False
        """Whether the two contradict each other for good."""
        self.changed = False
        """Whether the last look began or ended the doubt."""
        self.apart = 0.0
        """Smoothed distance from what was expected, rad."""
        self.limit = LEAST_LIMIT
        """Distance from which on they contradict each other, rad."""
        self.excess = 0.0
        """How far beyond the usual they lie right now, rad."""
        self.turned = 0.0
        """Part of the last distance that is a turn about the vertical, b seen from a, rad."""

    @property
    def calm(self) -> bool:
        """Whether what they differ by may be a slow drift: no contradiction, nor one coming up."""
        return not self.doubtful and self.apart < self.limit

    def look(
        self, t_ns: int, a: Quaternion, b: Quaternion, up_a: Vector, up_near: Vector | None
    ) -> None:
        """Take one look at both, bone-aligned.

        Parameters
        ----------
        t_ns : int
            Instant.
        a, b : Quaternion
            q_world_segment as each says it.
        up_a, up_near : Vector
            The vertical in the frames of `a` and of the neighboring segment.
        """
        (ex, ey, ez), sd = self.link.expected(up_a, up_near)
        dx, dy, dz = turn_one(a, b)
        rx, ry, rz = dx - ex, dy - ey, dz - ez
        usual = sqrt(3.0) * sd
        self.turned = rx * up_a[0] + ry * up_a[1] + rz * up_a[2]
        self.excess = max(0.0, sqrt(rx * rx + ry * ry + rz * rz) - USUAL * usual)
        self._smooth(t_ns, (rx, ry, rz), usual)
        self._judge(t_ns)

    def _smooth(self, t_ns: int, r: Vector, usual: float) -> None:
        if self._before_ns is None or t_ns - self._before_ns > LASTS_NS:
            self._slow, self._usual, self._since_ns = (0.0, 0.0, 0.0), usual, None
            self._before_ns = t_ns
        share = 1.0 - exp(-(t_ns - self._before_ns) * 1e-9 / SMOOTH_S)
        self._before_ns = t_ns
        x, y, z = self._slow
        self._slow = (x + share * (r[0] - x), y + share * (r[1] - y), z + share * (r[2] - z))
        self._usual += share * (usual - self._usual)
        self.apart, self.limit = length_one(self._slow), max(LEAST_LIMIT, LIMIT * self._usual)

    def _judge(self, t_ns: int) -> None:
        self.changed = False
        against = self.apart < 0.5 * self.limit if self.doubtful else self.apart > self.limit
        if not against:
            self._since_ns = None
            return
        if self._since_ns is None:
            self._since_ns = t_ns
        if t_ns - self._since_ns >= (ENDS_NS if self.doubtful else LASTS_NS):
            self.doubtful, self.changed, self._since_ns = not self.doubtful, True, None
