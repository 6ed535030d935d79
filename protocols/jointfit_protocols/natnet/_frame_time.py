"""Time of other clocks than the server's in a NatNet frame. Law: fields to values; no unit guessed.

The precision timestamp, two u32, is that of a PTP clock: seconds, and a fraction whose unit the
vendor's documents do not tell. A fraction of 10^9 or more proves steps of 2^-32 s; if twenty frames
have none, it is nanoseconds, for of twenty even spread ones in 2^-32 s one would be that large with
probability 1 - 0.23^20. Zeros mean that there is no such clock.

The timecode (SMPTE, LTC) has hours, minutes, seconds and frames in its bytes 3 to 0, and parts of a
frame beside it; zeros mean that there is none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from jointfit_protocols.natnet._frame import FrameOfData

_NS = 10**9
DECIDING = 20
"""Frames that decide the unit of the fraction."""


class Timecode(NamedTuple):
    """SMPTE timecode of one frame."""

    hour: int
    minute: int
    second: int
    frame: int
    subframe: int

    @property
    def text(self) -> str:
        """Write it as it is spoken."""
        parts = f"{self.hour:02d}:{self.minute:02d}:{self.second:02d}:{self.frame:02d}"
        return f"{parts}.{self.subframe}" if self.subframe else parts


def timecode_of(frame: FrameOfData) -> Timecode | None:
    """Return the timecode of a frame; None if it has none."""
    if not frame.timecode and not frame.subframe:
        return None
    hour, minute, second, count = frame.timecode.to_bytes(4, "big")
    return Timecode(hour, minute, second, count, frame.subframe)


class PrecisionTime:
    """Reads precision timestamps as nanoseconds, once the unit of their fraction is certain."""

    def __init__(self) -> None:
        self._binary: bool | None = None
        self._seen = 0
        self.absent = 0
        """Frames in a row without one."""

    @property
    def decided(self) -> bool:
        """Whether the unit is certain."""
        return self._binary is not None

    def ns(self, precision: tuple[int, int] | None) -> int | None:
        """Return the instant in ns of its clock; None without one, or while the unit is open."""
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
