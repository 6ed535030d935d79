"""Codec of the board's frames: bytes to numbers and back, without port, clock and units.

 0    1    2         3 .. 6      7 .. 14                          15
| A5 | 5A | counter | time, us | w x y z, int16, little-endian  | sum of bytes 2..14 mod 256 |
"""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

from jointfit_protocols.corrupt import CHECKSUM, NO_START, CorruptBytes
from jointfit_protocols.resynchronizing_codec import ResynchronizingCodec

SIZE = 16
"""Length of a frame, bytes."""
SCALE = 32767
"""Number of counts for 1 in the quaternion."""
_HEAD = b"\xa5\x5a"
_START = re.compile(rb"\xa5(?:\x5a|\Z)")  # A5 at the end may begin a frame
_BODY = struct.Struct("<BI4h")


class BoardFrame(NamedTuple):
    """One frame with a valid checksum."""

    counter: int
    time_us: int
    counts: tuple[int, int, int, int]
    end: int = 0
    """Number of bytes that the codec received up to the end of the frame. The decoder
    computes the arrival time of the first byte of the frame from this number."""
    size: int = SIZE
    """Number of bytes on the wire."""


def encode(frame: BoardFrame) -> bytes:
    """Return the bytes of a frame."""
    body = _BODY.pack(frame.counter, frame.time_us, *frame.counts)
    return _HEAD + body + bytes((sum(body) & 0xFF,))


def board_codec() -> ResynchronizingCodec[BoardFrame]:
    """Return a new codec, which converts bytes in pieces of any size to frames."""
    return ResynchronizingCodec(_read, _START, longest_run=256, shortest=SIZE)


def _read(buffer: bytes, at: int, base: int) -> BoardFrame | CorruptBytes | None:
    """Return the frame that begins at `at`, the bytes to skip, or None for an incomplete frame."""
    if not _HEAD.startswith(buffer[at : at + 2]):
        return CorruptBytes(1, NO_START)
    if len(buffer) < at + SIZE:
        return None
    if sum(buffer[at + 2 : at + 15]) & 0xFF != buffer[at + 15]:
        return CorruptBytes(1, CHECKSUM)
    counter, time_us, w, x, y, z = _BODY.unpack_from(buffer, at + 2)
    return BoardFrame(counter, time_us, (w, x, y, z), base + at + SIZE)
