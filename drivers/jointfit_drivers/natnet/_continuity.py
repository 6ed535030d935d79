"""Frame numbers and stamps of one server: lost, repeated, late and restarted frames.

Invariant: pure. A frame count that no camera can have reached is a restart, never a loss.
"""

from __future__ import annotations

from typing import NamedTuple

_REORDERED = 100
"""Going back by less than this is a datagram that was overtaken; by more, a restart or a loop."""
_FASTEST_HZ = 2000
"""More frames a second than any camera system: a number further ahead was not counted up to."""
_BURST = 2000
"""Frames ahead that are believed without time passed: a queue that was emptied at once."""
_LATE_RUN = 10
"""So many late frames in a row are no reordering but a short loop of a recording."""


class Step(NamedTuple):
    """What one frame means for the stream."""

    use: bool = True
    lost: int = 0
    restarted: bool = False


_NEXT, _DROP, _RESTART = Step(), Step(use=False), Step(restarted=True)


class Continuity:
    """Judges each frame by its number and its stamp."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._ticks = self._arrival_ns = 0
        self._late_run = 0
        self.duplicates = 0
        """Frames dropped because their number was the last one's."""
        self.late = 0
        """Frames dropped because a later one had come."""

    def forget(self) -> None:
        """Begin anew with the next frame."""
        self._number = None

    def frame(self, number: int, ticks: int, arrival_ns: int) -> Step:
        """Return what a frame with this number and server stamp means.

        Parameters
        ----------
        number : int
            Frame number as sent.
        ticks : int
            A stamp of the server that grows with every frame.
        arrival_ns : int
            Host time of its arrival, ns.
        """
        step = self._judge(number, ticks, arrival_ns)
        if step.use:
            self._arrival_ns = arrival_ns
            self._number, self._ticks, self._late_run = number, ticks, 0
        return step

    def _judge(self, number: int, ticks: int, arrival_ns: int) -> Step:
        if self._number is None:
            return _NEXT
        ahead = number - self._number
        if ahead > 0:
            elapsed_ns = max(0, arrival_ns - self._arrival_ns)
            if ticks < self._ticks or ahead > _BURST + elapsed_ns * _FASTEST_HZ // 10**9:
                return _RESTART
            return _NEXT if ahead == 1 else Step(lost=ahead - 1)
        if ahead == 0:
            self.duplicates += 1
            return _DROP
        self._late_run += 1
        if ahead <= -_REORDERED or self._late_run >= _LATE_RUN:
            return _RESTART
        self.late += 1
        return _DROP
