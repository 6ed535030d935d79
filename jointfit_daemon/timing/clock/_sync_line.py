"""Matching of the sync edges of a device to the instants of the reference clock.

A sync line is a wire on which all connected devices timestamp the same pulse edges. The clock
estimates from arrivals convert these timestamps to host time with an error of a few milliseconds.
Two timestamps therefore belong to the same edge if the difference of their host times is small
compared with the interval between edges.
"""

from __future__ import annotations

from bisect import bisect_left
from typing import NamedTuple

UNAMBIGUOUS = 0.35
"""Largest difference between two estimates of the time of one edge, as a fraction of the interval
between edges."""
FARTHEST_NS = 20_000_000
"""Largest difference between two estimates of the time of one edge, ns."""
_INSTANTS = 512
"""Largest number of reference instants in memory. Above this number, the older half is
dropped.
"""
_WAITING = 64
"""Largest number of unmatched edges in memory for each device."""


class Edge(NamedTuple):
    """One edge with the timestamp of one device."""

    t_ns: int
    """Estimated host time, ns."""
    own_ns: int
    """Time on the device's own clock, ns."""


class SyncLine:
    """Matches the edges of devices to instants of the reference."""

    __slots__ = ("_instants", "_waiting", "unmatched")

    def __init__(self) -> None:
        self._instants: list[Edge] = []
        self._waiting: dict[str, list[Edge]] = {}
        self.unmatched = 0
        """Number of edges without a match, or with an ambiguous match."""

    def instant(self, edge: Edge) -> None:
        """Add the next instant of the reference clock: a camera frame or an edge."""
        instants = self._instants
        if instants and edge.t_ns <= instants[-1].t_ns:
            if instants[-1].t_ns - edge.t_ns < FARTHEST_NS:
                return
            instants.clear()  # the reference restarted
        instants.append(edge)
        if len(instants) > _INSTANTS:
            del instants[: _INSTANTS // 2]

    def pulse(self, name: str, edge: Edge) -> None:
        """Add an edge of another device on the line."""
        waiting = self._waiting.setdefault(name, [])
        waiting.append(edge)
        if len(waiting) > _WAITING:
            del waiting[0]
            self.unmatched += 1

    def match_edges(self, name: str) -> list[tuple[int, int]]:
        """Return the newly matched edges as (device time, reference time), ns."""
        waiting, instants = self._waiting.get(name), self._instants
        pairs: list[tuple[int, int]] = []
        while waiting and instants and waiting[0].t_ns < instants[-1].t_ns:
            edge = waiting.pop(0)
            after = bisect_left(instants, edge.t_ns, key=lambda instant: instant.t_ns)
            if after == 0:
                self.unmatched += 1
                continue

            left, right = instants[after - 1], instants[after]
            near = left if edge.t_ns - left.t_ns < right.t_ns - edge.t_ns else right
            reach = min(UNAMBIGUOUS * (right.t_ns - left.t_ns), FARTHEST_NS)
            if abs(near.t_ns - edge.t_ns) <= reach:
                pairs.append((edge.own_ns, near.own_ns))
            else:
                self.unmatched += 1
        return pairs
