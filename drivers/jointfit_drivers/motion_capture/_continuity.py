"""Detection of lost, repeated and late frames, and of restarts, by frame number and stamp.

Invariant: the module is pure. A step of the frame number that no camera system can reach is a
restart, never a loss.
"""

from __future__ import annotations

from typing import NamedTuple

_REORDERED = 100
"""Smallest decrease of the frame number that shows a restart of the server, or of a recording that
is played in a loop. A smaller decrease is a reordered datagram."""
_FASTEST_HZ = 2000
"""Upper limit of the frame rate of camera systems, Hz. If the number increases faster, the
server restarted."""
_BURST = 2000
"""Largest number of frames that may arrive at once, from a queue that was emptied."""
_LATE_RUN = 10
"""Number of consecutive frames with a decreased number from which the frames count as a short
recording in a loop, not as reordered datagrams."""


class FrameStep(NamedTuple):
    """Classification of one frame."""

    use: bool = True
    """Whether the frame is used. A repeated or late frame is not used."""

    lost: int = 0
    """Number of frames lost before this frame."""

    restarted: bool = False
    """Whether the server or its recording restarted before this frame."""


_NEXT, _DROP, _RESTART = FrameStep(), FrameStep(use=False), FrameStep(restarted=True)


class FrameContinuity:
    """Classifies each frame by its number and its stamp."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._ticks = self._arrival_ns = 0
        self._late_run = 0
        self.duplicates = 0
        """Number of frames dropped because they had the number of the previous frame."""
        self.late = 0
        """Number of frames dropped because a later frame had already arrived."""

    def forget(self) -> None:
        """Discard the state, so that the next frame is treated as the first."""
        self._number = None

    def frame(self, number: int, ticks: int, arrival_ns: int) -> FrameStep:
        """Return the classification of one frame.

        Parameters
        ----------
        number : int
            Frame number as sent.
        ticks : int
            Stamp of the server that increases with every frame.
        arrival_ns : int
            Host time at which the frame arrived, ns.
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
