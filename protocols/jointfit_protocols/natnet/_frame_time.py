"""Times in a NatNet frame that do not come from the server's clock.

These are the precision timestamp and the timecode. The precision timestamp consists of two u32 from
a PTP clock: seconds, and a fraction whose unit the vendor does not document. A fraction of 10^9 or
more implies units of 2^-32 s. If no such fraction occurs in twenty frames, the unit is nanoseconds.
With units of 2^-32 s, at least one of twenty uniformly distributed fractions would be 10^9 or more
with probability 1 - 0.23^20. If both numbers are zero, the server has no PTP clock.

The timecode (SMPTE, LTC) contains hours, minutes, seconds and frames in its bytes 3 to 0, and a
separate subframe. Zeros mean that there is no timecode.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from jointfit_protocols.natnet._frame import FrameOfData

_NS = 10**9
DECIDING = 20
"""Number of frames that determine the unit of the fraction."""


class Timecode(NamedTuple):
    """SMPTE timecode of one frame."""

    hour: int
    minute: int
    second: int
    frame: int
    subframe: int

    @property
    def text(self) -> str:
        """Timecode as text, ``HH:MM:SS:FF``, with the subframe after a dot unless it is 0."""
        parts = f"{self.hour:02d}:{self.minute:02d}:{self.second:02d}:{self.frame:02d}"
        return f"{parts}.{self.subframe}" if self.subframe else parts


def timecode_of(frame: FrameOfData) -> Timecode | None:
    """Return the timecode of a frame; None if the frame has none."""
    if not frame.timecode and not frame.subframe:
        return None
    hour, minute, second, count = frame.timecode.to_bytes(4, "big")
    return Timecode(hour, minute, second, count, frame.subframe)


class PrecisionTime:
    """Converts precision timestamps to ns when the unit of their fraction is known."""

    def __init__(self) -> None:
        self._binary: bool | None = None
        self._seen = 0

        self.absent = 0
        """Number of consecutive frames without a precision timestamp."""

    @property
    def decided(self) -> bool:
        """Whether the unit of the fraction is known."""
        return self._binary is not None

    def ns(self, precision: tuple[int, int] | None) -> int | None:
        """Return the time of the PTP clock, ns; None if it is missing or the unit is unknown."""
        if precision is None or precision == (0, 0):
            self.absent += 1
            return None
        self.absent = 0

        seconds, fraction = precision
        if fraction >= _NS:
            self._binary = True
        elif self._binary is None:
            self._seen += 1
            if self._seen >= DECIDING:
                self._binary = False

        if self._binary is None:
            return None
        return seconds * _NS + (fraction * _NS >> 32 if self._binary else fraction)
