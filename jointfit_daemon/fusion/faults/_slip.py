"""Tells whether two sensors of one segment still lie to each other as calibration saw it.

Law: pure, O(1) a look. Doubt is felt at once, as a distance beyond what is usual, and told only
when it lasts; it ends when it has been well below its limit for a while.
"""

from __future__ import annotations

from collections import deque
from math import exp, hypot, radians, sqrt
from typing import TYPE_CHECKING

from jointfit_daemon.kinematics.rotation_scalar import exp_one, turn_one
from jointfit_daemon.limb_model import SensorLink

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.model import Quaternion, Vector

SMOOTH_S = 0.4
LASTS_NS, ENDS_NS = 500_000_000, 2_000_000_000
LIMIT, LEAST_LIMIT = 2.4, radians(6.0)
"""Distance, smoothed, in units of its usual RMS length, from which on something slipped: healthy
sensors stay below 1.5 for hours (simulated skin), below 2.1 in movements that were not trained
(real skin)."""
CALM = 0.65
"""Share of the limit below which a doubt may end."""
LEVEL = 0.75
"""Share of the limit up to which what is no turn about the vertical may be skin."""
USUAL = 1.5
"""Distance in the same units that is still no reason for doubt."""
USUAL_SLOW = 1.2
"""The same of the mean distance over the last second."""
LATELY_S, JUST_BEFORE = 1.0, 10
"""Of the mean; and looks back, 0.4 s, to what was just before."""
UNTRAINED_SD = radians(5.0)
"""Per component, of pairs that no movement has been seen of."""


def untrained(a: str, b: str) -> SensorLink:
    """Return what is expected of a pair of which only the static pose is known: nothing much."""
    zero = (0.0,) * 10
    return SensorLink(a, b, "pair", (), (zero, zero, zero), zero, zero, 0.0, UNTRAINED_SD)


def together(pairs: Sequence[PairWatch]) -> dict[str, Quaternion]:
    """Return how to turn the sensors of a segment, in its axes, to lie as usual to each other.

    Each moves by the mean of what it lies beyond the usual, so that none is preferred.
    """
    names = {name for pair in pairs for name in (pair.link.a, pair.link.b)}
    moves = {}
    for name in names:
        x = y = z = 0.0
        for pair in pairs:
            if pair.apart_too_far and name in (pair.link.a, pair.link.b):
                share = (1.0 if name == pair.link.a else -1.0) / len(names)
                vx, vy, vz = pair.beyond
                x, y, z = x + share * vx, y + share * vy, z + share * vz
        moves[name] = exp_one((x, y, z))
    return moves


class LastingDoubt:
    """Doubts what has been too far apart for a while, until it has been well within for longer."""

    def __init__(self) -> None:
        self.doubtful = False
        self._since_ns: int | None = None

    def begin_again(self) -> None:
        """Count from now on."""
        self._since_ns = None

    def judge(self, t_ns: int, apart: float, limit: float) -> bool:
        """Take a distance; return whether the doubt began or ended with it."""
        against = apart < CALM * limit if self.doubtful else apart > limit
        if not against:
            self._since_ns = None
            return False
        if self._since_ns is None:
            self._since_ns = t_ns
        if t_ns - self._since_ns < (ENDS_NS if self.doubtful else LASTS_NS):
            return False
        self.doubtful, self._since_ns = not self.doubtful, None
        return True


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
        self._tilt: Vector = (0.0, 0.0, 0.0)
        self._lately: Vector = (0.0, 0.0, 0.0)
        self._looks: deque[Vector] = deque(maxlen=JUST_BEFORE)
        self._usual = 0.0
        self._before_ns: int | None = None
        self._doubt = LastingDoubt()
        self.changed = False
        """Whether the last look began or ended the doubt."""
        self.apart = 0.0
        """Smoothed distance from what was expected, rad."""
        self.limit = LEAST_LIMIT
        """Distance from which on they contradict each other, rad."""
        self.excess = 0.0
        """How far beyond the usual they lie right now, rad, what is taken out left aside."""
        self.beyond: Vector = (0.0, 0.0, 0.0)
        """How to turn b, seen from a, segment's axes, rad, while they lie further now."""
        self.apart_too_far = False
        """Whether they lie further apart than usual now."""
        self.turned = 0.0
        """Part of the last distance that is a turn about the vertical, b seen from a, rad."""

    @property
    def doubtful(self) -> bool:
        """Whether the two contradict each other for good."""
        return self._doubt.doubtful

    @property
    def tilted(self) -> bool:
        """Whether they contradict each other, or soon will, in more than heading."""
        return not self.calm and hypot(*self._tilt) > LEVEL * self.limit

    @property
    def calm(self) -> bool:
        """Whether what they differ by may be a slow drift: no contradiction, nor one coming up."""
        return not self.doubtful and self.apart < self.limit

    def silent(self) -> None:
        """Take it that one of them says nothing."""
        self.excess, self.apart_too_far = 0.0, False

    def look(
        self,
        t_ns: int,
        a: Quaternion,
        b: Quaternion,
        ups: tuple[Vector, Vector | None],
        *,
        taken: float = 0.0,
    ) -> None:
        """Take one look at both, bone-aligned.

        Parameters
        ----------
        t_ns : int
            Instant.
        a, b : Quaternion
            q_world_segment as each says it.
        ups : tuple of Vector
            The vertical in the frames of `a` and of the neighboring segment.
        taken : float
            Turn about the vertical, b against a, that is taken out of what is given, rad.
        """
        up_a, up_near = ups
        (ex, ey, ez), sd = self.link.expected(up_a, up_near)
        dx, dy, dz = turn_one(a, b)
        left = rx, ry, rz = dx - ex, dy - ey, dz - ez
        usual = sqrt(3.0) * sd
        ux, uy, uz = up_a
        turned = rx * ux + ry * uy + rz * uz
        self.turned = turned + taken
        tilted = (rx - turned * ux, ry - turned * uy, rz - turned * uz)
        r = (rx + taken * ux, ry + taken * uy, rz + taken * uz)
        self._smooth(t_ns, r, left, tilted, usual=usual)
        self._exceed(left, usual)
        self.changed = self._doubt.judge(t_ns, self.apart, self.limit)

    def _exceed(self, r: Vector, usual: float) -> None:
        """See how far beyond the usual they lie: now, for the last second, and against just before.

        Skin may hide a slip in the very moment, but hardly in what has just changed as well.
        """
        length = hypot(*r)
        beyond = max(0.0, length - USUAL * usual)
        self.apart_too_far = beyond > 0.0
        if self.apart_too_far:
            share = beyond / length
            self.beyond = (share * r[0], share * r[1], share * r[2])
        x, y, z = self._looks[0]
        self._looks.append(r)
        changed = hypot(r[0] - x, r[1] - y, r[2] - z) - USUAL * usual
        slow = hypot(*self._lately) - USUAL_SLOW * usual
        self.excess = max(beyond, changed, slow)

    def _smooth(self, t_ns: int, r: Vector, left: Vector, tilted: Vector, *, usual: float) -> None:
        if self._before_ns is None or t_ns - self._before_ns > LASTS_NS:
            self._slow = self._tilt = (0.0, 0.0, 0.0)
            self._lately = left
            self._looks.clear()
            self._looks.append(left)
            self._usual, self._before_ns = usual, t_ns
            self._doubt.begin_again()
        dt = (t_ns - self._before_ns) * 1e-9
        share = 1.0 - exp(-dt / SMOOTH_S)
        self._before_ns = t_ns
        self._lately = _nearer(self._lately, left, 1.0 - exp(-dt / LATELY_S))
        self._slow, self._tilt = _nearer(self._slow, r, share), _nearer(self._tilt, tilted, share)
        self._usual += share * (usual - self._usual)
        self.apart, self.limit = hypot(*self._slow), max(LEAST_LIMIT, LIMIT * self._usual)


def _nearer(x: Vector, y: Vector, share: float) -> Vector:
    return (
        x[0] + share * (y[0] - x[0]),
        x[1] + share * (y[1] - x[1]),
        x[2] + share * (y[2] - x[2]),
    )
