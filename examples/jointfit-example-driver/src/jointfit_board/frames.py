"""Codec of the board's frames: bytes to numbers and back; no port, no clock, no units.

 0    1    2         3 .. 6      7 .. 14                          15
| A5 | 5A | counter | time, us | w x y z, int16, little-endian  | sum of bytes 2..14 mod 256 |
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes

SIZE = 16
"""Length of a frame, bytes."""
SCALE = 32767
"""Counts of 1 in the quaternion."""
_HEAD = b"\xa5\x5a"
_BODY = struct.Struct("<BI4h")


class BoardFrame(NamedTuple):
    """One frame with a valid checksum."""

    counter: int
    time_us: int
    counts: tuple[int, int, int, int]
    end: int = 0
    """Number of bytes fed to the codec up to the end of the frame, for back-dating."""


def encode(frame: BoardFrame) -> bytes:
    """Return the bytes of a frame."""
    body = _BODY.pack(frame.counter, frame.time_us, *frame.counts)
    return _HEAD + body + bytes((sum(body) & 0xFF,))


class BoardCodec:
    """Converts bytes, in pieces of any size, to frames."""

    def __init__(self) -> None:
        self._pending = b""  # always shorter than a frame between calls
        self.fed = self.frames = self.discarded = 0

    def feed(self, data: bytes) -> list[BoardFrame | CorruptBytes]:
        """Return the frames completed by `data`, in wire order; never raises."""
        buffer, start = self._pending + data, self.fed - len(self._pending)
        self.fed += len(data)

        found: list[BoardFrame | CorruptBytes] = []
        at = skipped = 0
        while len(buffer) - at >= SIZE:
            if (
                buffer[at : at + 2] != _HEAD
                or sum(buffer[at + 2 : at + 15]) & 0xFF != buffer[at + 15]
            ):
                at += 1  # a valid frame may begin inside an invalid one: skip one byte, not all
                skipped += 1
                continue
            found += self._corrupt(skipped)
            skipped = 0
            counter, time_us, w, x, y, z = _BODY.unpack_from(buffer, at + 2)
            at += SIZE
            found.append(BoardFrame(counter, time_us, (w, x, y, z), start + at))
            self.frames += 1

        self._pending = buffer[at:]
        return found + self._corrupt(skipped)

    def flush(self) -> list[CorruptBytes]:
        """Discard pending bytes; they are shorter than a frame and contain none."""
        pending, self._pending = len(self._pending), b""
        return self._corrupt(pending)

    def _corrupt(self, count: int) -> list[CorruptBytes]:
        self.discarded += count
        return [CorruptBytes(count, "no frame starts here")] if count else []
