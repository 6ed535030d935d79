"""Frame numbers and stamps of one server: lost, repeated, late and restarted frames.

Invariant: pure. A frame number that no camera can have reached is a restart, never a loss.
"""

from __future__ import annotations

from typing import NamedTuple

_REORDERED = 100
"""Frames by which a number may decrease in a reordered datagram; more is a restart or a loop."""
_FASTEST_HZ = 2000
"""Upper limit of the frame rate of camera systems, Hz: a larger step of the number is not due to
lost frames."""
_BURST = 2000
"""Frames that may arrive at once, from a queue that was emptied."""
_LATE_RUN = 10
"""Consecutive late frames that are no reordering but a short loop of a recording."""


class FrameStep(NamedTuple):
    """Classification of one frame."""

    use: bool = True
    lost: int = 0
    restarted: bool = False


_NEXT, _DROP, _RESTART = FrameStep(), FrameStep(use=False), FrameStep(restarted=True)


class FrameContinuity:
    """Classifies each frame by its number and its stamp."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._ticks = self._arrival_ns = 0
        self._late_run = 0
        self.duplicates = 0
        """Number of frames dropped because they had the number of the preceding frame."""
        self.late = 0
        """Frames dropped because a later one had arrived."""

    def forget(self) -> None:
        """Start again with the next frame."""
        self._number = None

    def frame(self, number: int, ticks: int, arrival_ns: int) -> FrameStep:
        """Return the step for one frame.

        Parameters
        ----------
        number : int
            Frame number as sent.
        ticks : int
            A stamp of the server that increases with every frame.
        arrival_ns : int
            Host time of its arrival, ns.
        """
        step = _NEXT
        if self._number is not None:
            ahead = number - self._number
            if ahead == 0:
                self.duplicates += 1
                return _DROP

            if ahead > 0:
                elapsed_ns = max(0, arrival_ns - self._arrival_ns)
                if ticks < self._ticks or ahead > _BURST + elapsed_ns * _FASTEST_HZ // 10**9:
                    step = _RESTART
                elif ahead > 1:
                    step = FrameStep(lost=ahead - 1)
            else:
                self._late_run += 1
                if ahead > -_REORDERED and self._late_run < _LATE_RUN:
                    self.late += 1
                    return _DROP
                step = _RESTART

        self._arrival_ns = arrival_ns
        self._number, self._ticks, self._late_run = number, ticks, 0
        return step
