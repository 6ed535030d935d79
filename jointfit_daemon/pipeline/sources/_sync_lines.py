"""The sync lines of a rig: whose edges are whose.

Law: deterministic; knows clocks and edges, no measurements. The reference of a line is the cameras
if their table names it (``sync_line``: an edge at every exposure), else the first source whose edge
arrived. All others on the line are tied to it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.timing.clock import SYNC_STALE_NS, Edge, SyncLine

if TYPE_CHECKING:
    from jointfit_daemon.timing.clock import DeviceClock


class _Line:
    __slots__ = ("clocks", "edges", "heard_ns", "reference")

    def __init__(self) -> None:
        self.edges = SyncLine()
        self.reference: str | None = None
        self.heard_ns = 0
        self.clocks: dict[str, DeviceClock] = {}


class SyncLines:
    """All sync lines, by number."""

    def __init__(self) -> None:
        self._lines: dict[int, _Line] = {}
        self._cameras: dict[int, str] = {}

    @property
    def unmatched(self) -> int:
        """Edges that could not be told from their neighbors."""
        return sum(line.edges.unmatched for line in self._lines.values())

    def exposures(self, number: int, source: str, clock: DeviceClock, edge: Edge) -> None:
        """Take a camera frame whose exposure made an edge on line `number`."""
        self._cameras[number] = source
        self._instant(number, source, clock, edge)

    def edge(self, number: int, source: str, clock: DeviceClock, edge: Edge) -> None:
        """Take an edge that `source` stamped on line `number`."""
        line = self._lines.setdefault(number, _Line())
        silent = edge.t_ns - line.heard_ns > SYNC_STALE_NS
        if line.reference is None or (silent and number not in self._cameras):
            line.reference, line.edges = source, SyncLine()
        if line.reference == source:
            self._instant(number, source, clock, edge)
            return
        line.clocks[source] = clock
        line.edges.pulse(source, edge)
        self._tie(line, source)

    def _instant(self, number: int, source: str, clock: DeviceClock, edge: Edge) -> None:
        line = self._lines.setdefault(number, _Line())
        if line.reference != source:
            line.reference, line.edges = source, SyncLine()
        line.clocks[source], line.heard_ns = clock, edge.t_ns
        line.edges.instant(edge)
        for name in line.clocks:
            if name != source:
                self._tie(line, name)

    def _tie(self, line: _Line, name: str) -> None:
        reference = line.clocks.get(line.reference or "")
        for own, other in line.edges.matched(name):
            if reference is not None:
                line.clocks[name].feed_sync_edge(own, other, reference)
