"""Frames of the mode UART-RVC, which a device sends 100 times per second without any command.

 0    1    2       3 .. 8                9 .. 14         15 .. 17   18
| AA | AA | index | yaw, pitch, roll | acceleration xyz | reserved | sum of bytes 2..17 mod 256 |

The line speed is 115200 baud. Angles are int16 in 0.01 degrees, and accelerations are int16 in
1/1000 g, little-endian.

Source: BNO080 data sheet 1000-3927, section 1.3.5.2.

Invariant: the codec converts bytes to frames. It uses no port and no clock.
"""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

from jointfit_protocols.corrupt import CHECKSUM, CorruptBytes
from jointfit_protocols.resynchronizing_codec import ResynchronizingCodec

RVC_BYTES = 19
"""Length of a frame, bytes."""
_MARK = 0xAA
_MARKS = b"\xaa\xaa"
_BODY = struct.Struct("<B6h3s")
_unpack, _new_tuple = _BODY.unpack_from, tuple.__new__
_RUN = 1024
"""Number of noise bytes after which a run is reported, so that the number of corrupt bytes is up to
date."""
_START = re.compile(b"\xaa")
_NO_START = CorruptBytes(1, "no frame starts here")
_CHECKSUM = CorruptBytes(1, CHECKSUM)

Counts = tuple[int, int, int]


class RvcFrame(NamedTuple):
    """One frame with a valid checksum."""

    number: int
    """Index of the frame, modulo 256."""
    angles: Counts
    """Yaw, pitch and roll, 0.01 degrees."""
    acceleration: Counts
    """Specific force along x, y, z, 1/1000 g."""
    reserved: bytes = bytes(3)
    end: int = 0
    """Number of bytes fed to the codec until the end of the checksum. Drivers compute the
    arrival time of the first byte from this number."""

    @property
    def size(self) -> int:
        """Length of the frame on the wire, bytes."""
        return RVC_BYTES


def encode_rvc(frame: RvcFrame) -> bytes:
    """Return the bytes of a frame on the wire."""
    body = _BODY.pack(frame.number, *frame.angles, *frame.acceleration, frame.reserved)
    return bytes((_MARK, _MARK)) + body + bytes((sum(body) & 0xFF,))


def _read_frame(buffer: bytes, at: int, base: int) -> RvcFrame | CorruptBytes | None:
    """Return the frame at `at`, the reason why there is none, or None if it is incomplete."""
    after = at + RVC_BYTES
    if after > len(buffer):
        return None if buffer[at] == _MARK else _NO_START
    if not buffer.startswith(_MARKS, at):
        return _NO_START
    if sum(buffer[at + 2 : after - 1]) & 0xFF != buffer[after - 1]:
        return _CHECKSUM
    number, yaw, pitch, roll, x, y, z, reserved = _unpack(buffer, at + 2)
    fields = (number, (yaw, pitch, roll), (x, y, z), reserved, base + after)
    return _new_tuple(RvcFrame, fields)  # takes half the time of RvcFrame()


class RvcCodec(ResynchronizingCodec[RvcFrame]):
    """Codec that converts a byte stream to frames; the stream may be split at any position.

    Runs of corrupt bytes are reported after at most 1024 bytes.
    """

    def __init__(self) -> None:
        super().__init__(_read_frame, _START, _RUN, _NO_START.reason, RVC_BYTES)

    def feed(self, data: bytes) -> list[RvcFrame | CorruptBytes]:  # type: ignore[explicit-override]  # typing.override needs Python 3.12
        """Return the frames that `data` completes, in wire order; never raise."""
        # Usually `data` is exactly one frame, which requires no search.
        if len(data) == RVC_BYTES and not self._pending and not self._run.count:
            found = _read_frame(data, 0, self.fed)
            if type(found) is RvcFrame:
                self.fed += RVC_BYTES
                self.messages += 1
                return [found]
        return super().feed(data)
