r"""Headings that turn within seconds: whose, by how much, and how sure that is.

Law: pure, O(1) a look; only differences of headings are seen, so somebody must be believed.

Iron nearby pulls the heading of a sensor that has a magnetometer away within seconds and lets it go
later. Sensors of one segment see it in each other, segments of a hinge in the axis they share. From
these differences every sensor gets a heading :math:`h_i` against the first, and what is taken out
of it is its distance from the weighted median, each segment weighing the same:

.. math:: o_i = h_i - \mathrm{median}(h), \qquad
          \text{taken out: } o_i \cdot \mathrm{clip}\bigl((|o_i| - s_0) / (s_1 - s_0), 0, 1\bigr)

One sensor of four that turns is thus found and put right, and the others stay as they are. Where
half of the segments say one thing and half another, the median is an interval: its middle is
taken, which keeps the angles of the joint, and its half width is how wrong all headings may be.
"""

from __future__ import annotations

from math import exp
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

SMOOTH_S, FOLLOW_S = 0.4, 0.25
"""Of what is seen, and of what is taken out."""
FORGET_NS = 500_000_000
"""A difference that was not seen for longer begins anew."""
FROM, FULLY = 1.6, 3.2
"""Distances from the median from which on, and from which on fully, it is taken out: standard
deviations of a look across a joint."""
FORGOTTEN = 0.002
"""What is left of a turn that is over, rad, and taken out no more."""
LEAST_SD = 0.026
"""Of such a look, rad: 1.5 degrees."""


class Look(NamedTuple):
    """Heading of sensor `b` against sensor `a`, beyond what posture and drift make expect."""

    a: str
    b: str
    turn: float
    """rad."""
    sd: float
    """Standard deviation of a healthy one, rad."""


class _Seen:
    __slots__ = ("before_ns", "sd", "turn")

    def __init__(self) -> None:
        self.turn, self.sd = 0.0, LEAST_SD
        self.before_ns: int | None = None

    def look(self, t_ns: int, turn: float, sd: float) -> None:
        if self.before_ns is None or t_ns - self.before_ns > FORGET_NS:
            self.turn, self.before_ns = 0.0, t_ns
        share = 1.0 - exp(-(t_ns - self.before_ns) * 1e-9 / SMOOTH_S)
        self.turn += share * (turn - self.turn)
        self.sd, self.before_ns = sd, t_ns


class SuddenTurns:
    """Follows the headings of a limb's sensors against each other.

    Parameters
    ----------
    groups : sequence of sequence of str
        Sensor ids by segment.
    """

    def __init__(self, groups: Sequence[Sequence[str]]) -> None:
        self._segment = {name: i for i, group in enumerate(groups) for name in group}
        self._seen: dict[tuple[str, str], _Seen] = {}
        self.taken: dict[str, float] = {}
        """What is to be taken out of the headings of sensors, rad; others stay as they are."""
        self.unsure = 0.0
        """How wrong the headings of all may be because half of them contradict the others, rad."""
        self._before_ns: int | None = None
        self.off: dict[str, float] = {}
        """How far sensors are from the median, rad, as long as anyone may be far."""

    def look(self, t_ns: int, looks: Iterable[Look]) -> bool:
        """Take one look at all; return whether what is to be taken out has changed.

        Parameters
        ----------
        t_ns : int
            Instant.
        looks : iterable of Look
            Within segments and across hinges; together they must not contradict each other, so
            there is one way at most from sensor to sensor.
        """
        edges = []
        apart, widest = 0.0, LEAST_SD
        for a, b, turn, sd in looks:
            seen = self._seen.get((a, b))
            if seen is None:
                seen = self._seen[a, b] = _Seen()
            seen.look(t_ns, turn, sd)
            apart, widest = apart + abs(seen.turn), max(widest, sd)
            edges.append((a, b, seen))
        wanted: dict[str, float] = {}
        self.off, unsure = {}, 0.0
        if apart > FROM * widest:  # nobody can be further from the median than that
            wanted, unsure = self._decide(edges)
        return self._follow(t_ns, wanted, unsure)

    def odd(self, a: str, b: str) -> tuple[str, float] | None:
        """Return which of two sensors is off against all others while the other is not."""
        name, other = (a, b) if abs(self.off.get(a, 0.0)) > abs(self.off.get(b, 0.0)) else (b, a)
        off, near = self.off.get(name, 0.0), self.off.get(other, 0.0)
        return (name, off) if name in self.taken and abs(near) < 0.5 * abs(off) else None

    def _follow(self, t_ns: int, wanted: Mapping[str, float], unsure: float) -> bool:
        """Let what is taken out go where it should be, without a jump."""
        share = 1.0 - exp(-(t_ns - (self._before_ns or t_ns)) * 1e-9 / FOLLOW_S)
        self._before_ns = t_ns
        if not wanted and not self.taken:
            self.unsure = 0.0
            return False
        moved = {}
        for name in {**self.taken, **wanted}:
            before = self.taken.get(name, 0.0)
            turn = before + share * (wanted.get(name, 0.0) - before)
            if name in wanted or abs(turn) > FORGOTTEN:
                moved[name] = turn
        self.taken = moved
        self.unsure += share * (unsure - self.unsure)
        return True

    def _decide(self, edges: list[tuple[str, str, _Seen]]) -> tuple[dict[str, float], float]:
        wanted, unsure = {}, 0.0
        for headings, sd in _tied(edges):
            if len({self._segment[name] for name in headings}) < 2:  # noqa: PLR2004 - no joint
                continue
            low, high = _median(self._weighted(headings))
            middle = 0.5 * (low + high)
            for name, heading in headings.items():
                self.off[name] = heading - middle
                taken = _ramp(heading - middle, sd)
                if taken:
                    wanted[name] = taken
                    # iron that pulls one may pull the others by as much as is not seen of it
                    unsure = max(unsure, min(abs(taken), sd))
            unsure = max(unsure, _ramp(0.5 * (high - low), sd))
        return wanted, unsure

    def _weighted(self, headings: Mapping[str, float]) -> list[tuple[float, float]]:
        counts: dict[int, int] = {}
        for name in headings:
            segment = self._segment[name]
            counts[segment] = counts.get(segment, 0) + 1
        return [(heading, 1.0 / counts[self._segment[name]]) for name, heading in headings.items()]


def _tied(edges: list[tuple[str, str, _Seen]]) -> list[tuple[dict[str, float], float]]:
    """Return the headings of sensors that are tied to each other, and the widest look among them.

    The first of each is at 0.
    """
    found: list[tuple[dict[str, float], float]] = []
    left = edges
    while left:
        headings, sd, before = {left[0][0]: 0.0}, LEAST_SD, -1
        while len(headings) != before:
            before, rest = len(headings), []
            for edge in left:
                a, b, seen = edge
                if a in headings:
                    headings[b] = headings[a] + seen.turn
                elif b in headings:
                    headings[a] = headings[b] - seen.turn
                else:
                    rest.append(edge)
                    continue
                sd = max(sd, seen.sd)
            left = rest
        found.append((headings, sd))
    return found


def _median(weighted: list[tuple[float, float]]) -> tuple[float, float]:
    """Return the lowest and highest value that has half of the weight on either side."""
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


def _ramp(turn: float, sd: float) -> float:
    """Return what of a turn is taken out: nothing of a small one, all of a large one."""
    share = (abs(turn) / sd - FROM) / (FULLY - FROM)
    return turn * min(max(share, 0.0), 1.0)
