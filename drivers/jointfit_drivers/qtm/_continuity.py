"""Order of the frames of one server of Qualisys Track Manager (QTM), by their time stamps.

Frame numbers are not reliable. They can stay at 1 in live preview. They increase by more than 1 per
frame if the real-time rate is a fraction of the camera rate, so losses are counted in units of the
usual step.

Invariant: the module is pure. A decrease of the stamp that reordering cannot explain shows a
restart, because the time of each measurement and of each loop of a recording begins at 0.
"""

from __future__ import annotations

from collections import deque

from jointfit_drivers.motion_capture import FrameStep

_REORDERED_US = 200_000
"""Largest decrease of the stamp in a reordered datagram, µs."""
_LATE_RUN = 10
"""Number of consecutive frames with a decreased stamp from which the frames count as a short
recording in a loop, not as reordered datagrams."""
_STEPS = 20
"""Number of recent steps of the frame number. The smallest of them is the usual step."""
_MOST_LOST = 100_000
"""Largest plausible loss, frames. A larger loss is a jump of the number."""

_NEXT, _DROP, _RESTART = FrameStep(), FrameStep(use=False), FrameStep(restarted=True)


class TimestampContinuity:
    """Classifies each frame by its time stamp: next, duplicate, late, or first after a restart."""

    def __init__(self) -> None:
        self._stamp_us: int | None = None
        self._number = 0
        self.number = 0
        """Number of the last accepted frame. It increases even if the number that QTM sends does
        not."""
        self._late_run = 0
        self._steps: deque[int] = deque(maxlen=_STEPS)
        self._intervals_us: deque[int] = deque(maxlen=_STEPS)
        self.duplicates = 0
        """Number of frames dropped because they had the stamp of the previous frame."""
        self.late = 0
        """Number of frames dropped because a later frame had already arrived."""

    @property
    def began(self) -> bool:
        """Whether a frame has arrived since the start or the last call of `forget`."""
        return self._stamp_us is not None

    def forget(self) -> None:
        """Discard the state, so that the next frame is treated as the first."""
        self._stamp_us = None
        self._steps.clear()
        self._intervals_us.clear()

    def frame(self, stamp_us: int, number: int) -> FrameStep:
        """Return the classification of one frame by its stamp, µs, and its number."""
        before, step = self._stamp_us, _NEXT
        advanced = number - self._number
        if before is None:
            self.number = number
        elif stamp_us == before:
            self.duplicates += 1
            return _DROP
        elif stamp_us < before:
            self._late_run += 1
            if before - stamp_us < _REORDERED_US and self._late_run < _LATE_RUN:
                self.late += 1
                return _DROP
            self.forget()
            self.number, step = number, _RESTART
        elif advanced > 0:
            self._steps.append(advanced)
            self.number += advanced
            lost = advanced // min(self._steps) - 1
            step = FrameStep(lost=lost) if 0 < lost < _MOST_LOST else _NEXT
        else:
            interval_us = stamp_us - before
            self._intervals_us.append(interval_us)
            self.number += max(1, round(interval_us / min(self._intervals_us)))
        self._stamp_us, self._number, self._late_run = stamp_us, number, 0
        return step
