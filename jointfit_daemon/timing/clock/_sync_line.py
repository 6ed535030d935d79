"""One electrical sync line: which edge of one device is which instant of the reference.

Law: pure; bounded memory. Every edge is the same instant on all devices of a line. The estimates
from arrivals are good to a few milliseconds, so of two edges that are estimated near each other,
and near compared with the time between edges, both are one.
"""

from __future__ import annotations

from bisect import bisect_left
from typing import NamedTuple

UNAMBIGUOUS = 0.35
"""Share of the time between edges by which two estimates of one edge may differ."""
FARTHEST_NS = 20_000_000
_INSTANTS = 512
_WAITING = 64


class Edge(NamedTuple):
    """One edge as one device stamped it."""

    t_ns: int
    """Its host time as estimated, ns."""
    own_ns: int
    """Its time on the device's own clock, ns."""


class SyncLine:
    """Matches edges of devices to instants of the reference."""

    __slots__ = ("_instants", "_waiting", "unmatched")

    def __init__(self) -> None:
        self._instants: list[Edge] = []
        self._waiting: dict[str, list[Edge]] = {}
        self.unmatched = 0
        """Edges that were no instant of the reference, or not clearly one."""

    def instant(self, edge: Edge) -> None:
        """Take the next instant of the reference: a camera frame, or an edge it stamped."""
        instants = self._instants
        if instants and edge.t_ns <= instants[-1].t_ns:
            if instants[-1].t_ns - edge.t_ns < FARTHEST_NS:
                return
            instants.clear()  # the reference began anew
        instants.append(edge)
        if len(instants) > _INSTANTS:
            del instants[: _INSTANTS // 2]

    def pulse(self, name: str, edge: Edge) -> None:
        """Take an edge of another device on the line."""
        waiting = self._waiting.setdefault(name, [])
        waiting.append(edge)
        if len(waiting) > _WAITING:
            del waiting[0]
            self.unmatched += 1

    def matched(self, name: str) -> list[tuple[int, int]]:
        """Return (own time, reference's own time), ns, of the edges that can be told by now."""
        waiting, instants = self._waiting.get(name), self._instants
        pairs: list[tuple[int, int]] = []
        while waiting and instants and waiting[0].t_ns < instants[-1].t_ns:
            edge = waiting.pop(0)
            found = self._nearest(edge.t_ns)
            if found is None:
                self.unmatched += 1
            else:
                pairs.append((edge.own_ns, found.own_ns))
        return pairs

    def _nearest(self, t_ns: int) -> Edge | None:
        instants = self._instants
        after = bisect_left(instants, t_ns, key=lambda edge: edge.t_ns)
        if after == 0:
            return None
        left, right = instants[after - 1], instants[after]
        apart = right.t_ns - left.t_ns
        near = left if t_ns - left.t_ns < right.t_ns - t_ns else right
        off = abs(near.t_ns - t_ns)
        return near if off <= min(UNAMBIGUOUS * apart, FARTHEST_NS) else None
