"""Frames of the mode UART-RVC: 100 per second at 115200 baud, without any command.

 0    1    2       3 .. 8                9 .. 14         15 .. 17   18
| AA | AA | index | yaw, pitch, roll | acceleration xyz | reserved | sum of bytes 2..17 mod 256 |

Angles are int16 in 0.01 degrees, accelerations int16 in 1/1000 g, little-endian.

Source: BNO080 data sheet 1000-3927, section 1.3.5.2.

Invariant: bytes in, frames out; no port, no clock.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes

RVC_BYTES = 19
"""Bytes of a frame."""
_MARK = 0xAA
_BODY = struct.Struct("<B6h3s")
_unpack, _new_tuple = _BODY.unpack_from, tuple.__new__
_RUN = 1024
"""Bytes of noise after which a run is reported, so that the sum of corrupt bytes is up to date."""
_NO_START, _CHECKSUM = "no frame starts here", "checksum"

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
    """Bytes fed to the codec up to and including the checksum, for back-dating."""

    @property
    def size(self) -> int:
        """Bytes on the wire."""
        return RVC_BYTES


def encode_rvc(frame: RvcFrame) -> bytes:
    """Return the frame on the wire."""
    body = _BODY.pack(frame.number, *frame.angles, *frame.acceleration, frame.reserved)
    return bytes((_MARK, _MARK)) + body + bytes((sum(body) & 0xFF,))


class RvcCodec:
    """Decoder of pieces of any size to frames; the result does not depend on the pieces.

    A run of bytes without a frame becomes one `CorruptBytes`: before the frame that ends it, at
    `flush`, or every 1024 bytes.
    """

    def __init__(self) -> None:
        self._pending = b""  # under one frame between calls
        self._run = 0
        self._reason = ""
        self.fed = 0
        """Bytes fed so far."""
        self.frames = 0
        """Frames so far."""
        self.discarded = 0
        """Bytes without a frame so far."""

    @property
    def pending(self) -> int:
        """Bytes of an incomplete frame."""
        return len(self._pending)

    def feed(self, data: bytes) -> list[RvcFrame | CorruptBytes]:
        """Return the frames that `data` completed, in wire order; never raises."""
        # The usual piece is one frame.
        if len(data) == RVC_BYTES and not self._pending and not self._run and _is_frame(data):
            self.fed += RVC_BYTES
            self.frames += 1
            return [_frame(data, 0, self.fed)]

        buffer = self._pending + data if self._pending else bytes(data)
        base = self.fed - len(self._pending)
        self.fed += len(data)
        found: list[RvcFrame | CorruptBytes] = []

        at, end = 0, len(buffer)
        last = end - RVC_BYTES
        while at < end:
            if at <= last and buffer[at] == _MARK and buffer[at + 1] == _MARK:
                done = at + RVC_BYTES
                if sum(buffer[at + 2 : done - 1]) & 0xFF == buffer[done - 1]:
                    if self._run:
                        self._end_run(found)
                    found.append(_frame(buffer, at, base + done))
                    self.frames += 1
                    at = done
                    continue
                # A valid frame may start inside a corrupt one: skip one byte only.
                self._skip(1, _CHECKSUM, found)
                at += 1
            elif buffer[at] == _MARK:
                if at > last:
                    break
                self._skip(1, _NO_START, found)
                at += 1
            else:
                after = buffer.find(_MARK, at)
                after = end if after < 0 else after
                self._skip(after - at, _NO_START, found)
                at = after

        self._pending = buffer[at:] if at < end else b""
        return found

    def flush(self) -> list[RvcFrame | CorruptBytes]:
        """End the input, or a silence: pending bytes are fewer than a frame and contain none."""
        found: list[RvcFrame | CorruptBytes] = []
        if self._pending:
            self._skip(len(self._pending), "cut off", found)
            self._pending = b""
        if self._run:
            self._end_run(found)
        return found

    def _skip(self, count: int, reason: str, found: list[RvcFrame | CorruptBytes]) -> None:
        """Count bytes without a frame; the first fault names the run."""
        self.discarded += count
        if self._run == 0 or self._reason == _NO_START:
            self._reason = reason
        self._run += count
        while self._run >= _RUN:
            found.append(CorruptBytes(_RUN, self._reason))
            self._run -= _RUN
            self._reason = reason

    def _end_run(self, found: list[RvcFrame | CorruptBytes]) -> None:
        found.append(CorruptBytes(self._run, self._reason))
        self._run = 0


def _is_frame(data: bytes) -> bool:
    """Return whether 19 bytes are a frame."""
    return data[0] == data[1] == _MARK and sum(data[2:-1]) & 0xFF == data[-1]


def _frame(buffer: bytes, at: int, end: int) -> RvcFrame:
    body = _unpack(buffer, at + 2)
    fields = (body[0], body[1:4], body[4:7], body[7], end)
    return _new_tuple(RvcFrame, fields)  # half the time of RvcFrame()
