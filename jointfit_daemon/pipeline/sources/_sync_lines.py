"""Sync lines of a rig: edges from different sources are assigned to common instants.

A sync line is a wire on which all connected devices timestamp the same pulse edges. The reference
of a line is the mocap source whose table names the line (``sync_line``), because this source sends
one edge per exposure. Without such a source, the reference is the first source whose edge arrives.
If this reference is silent for `SYNC_STALE_NS`, the next source whose edge arrives replaces it. The
clocks of all other sources on the line are synchronized to the clock of the reference.

Invariant: the result depends only on the edges, the clocks, and their order of arrival.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.timing.clock import SYNC_STALE_NS, Edge, SyncLine

if TYPE_CHECKING:
    from jointfit_daemon.timing.clock import DeviceClock


class _Line:
    __slots__ = ("clocks", "edges", "last_ns", "reference")

    def __init__(self) -> None:
        self.edges = SyncLine()
        self.reference: str | None = None
        self.last_ns = 0
        self.clocks: dict[str, DeviceClock] = {}


class SyncLines:
    """All sync lines of a rig, by number."""

    def __init__(self) -> None:
        self._lines: dict[int, _Line] = {}
        self._mocap_lines: set[int] = set()

    def add_exposure(self, number: int, source: str, clock: DeviceClock, edge: Edge) -> None:
        """Add a mocap frame whose exposure generated an edge on line `number`."""
        self._mocap_lines.add(number)
        self._add_reference_edge(number, source, clock, edge)

    def add_edge(self, number: int, source: str, clock: DeviceClock, edge: Edge) -> None:
        """Add an edge on line `number` that `source` stamped."""
        line = self._lines.setdefault(number, _Line())
        silent = edge.t_ns - line.last_ns > SYNC_STALE_NS
        if line.reference is None or (silent and number not in self._mocap_lines):
            line.reference, line.edges = source, SyncLine()

        if line.reference == source:
            self._add_reference_edge(number, source, clock, edge)
            return
        line.clocks[source] = clock
        line.edges.pulse(source, edge)
        self._tie(line, source)

    def _add_reference_edge(self, number: int, source: str, clock: DeviceClock, edge: Edge) -> None:
        line = self._lines.setdefault(number, _Line())
        if line.reference != source:
            line.reference, line.edges = source, SyncLine()
        line.clocks[source], line.last_ns = clock, edge.t_ns
        line.edges.instant(edge)
        for name in line.clocks:
            if name != source:
                self._tie(line, name)

    def _tie(self, line: _Line, name: str) -> None:
        reference = line.clocks.get(line.reference or "")
        for own, other in line.edges.match_edges(name):
            if reference is not None:
                line.clocks[name].feed_sync_edge(own, other, reference)
