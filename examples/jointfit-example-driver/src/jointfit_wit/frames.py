"""WitMotion frames, UART. Law: bytes in, counts out; no port, no clock, no unit.

 0    1      2 .. 9                      10
| 55 | type | 4 x int16, little-endian | sum of bytes 0..9 mod 256 |    type 50..5F

Type 59 is the quaternion w x y z, 1/32768. Commands to the device are FF AA register low high.
Source: the vendor's protocol pages.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes

QUATERNION = 0x59
ACCELERATION = 0x51
SCALE = 1.0 / 32768.0
SIZE = 11
UNLOCK = bytes.fromhex("ffaa6988b5")  # registers may be written for 10 s
SAVE = bytes.fromhex("ffaa000000")
CONTENT, RATE = 0x02, 0x03  # registers
CONTENT_QUATERNION = 1 << 9
RATES = {10: 0x06, 20: 0x07, 50: 0x08, 100: 0x09, 200: 0x0B}
OTHER_VARIANT = b"\x55\x61"  # Bluetooth and SD models: no checksum, no quaternion

_BODY = struct.Struct("<BB4h")
_START = 0x55
_TYPES = range(0x50, 0x60)


class WitFrame(NamedTuple):
    """One frame whose sum holds."""

    kind: int
    counts: tuple[int, int, int, int]
    end: int = 0
    """Bytes fed to the decoder up to and including the sum: for back-dating."""


def encode(kind: int, counts: tuple[int, int, int, int]) -> bytes:
    """Return a frame on the wire."""
    body = _BODY.pack(_START, kind, *counts)
    return body + bytes((sum(body) & 0xFF,))


def write_register(register: int, value: int) -> bytes:
    """Return the command that writes `value`; it takes effect only while unlocked."""
    return struct.pack("<BBBH", 0xFF, 0xAA, register, value)


class WitDecoder:
    """Bytes in pieces of any size in, frames out."""

    def __init__(self) -> None:
        self._pending = b""  # shorter than one frame between calls, so it needs no bound
        self._skipped = 0
        self.fed = 0
        """Bytes fed so far."""
        self.frames = 0
        """Frames so far."""
        self.discarded = 0
        """Bytes so far that belong to no frame."""

    def feed(self, data: bytes) -> list[WitFrame | CorruptBytes]:
        """Return what `data` completed, in wire order; never raises."""
        buffer, start = self._pending + data, self.fed - len(self._pending)
        self.fed += len(data)
        found: list[WitFrame | CorruptBytes] = []
        at = 0
        while len(buffer) - at >= SIZE:
            frame = buffer[at : at + SIZE]
            if frame[0] == _START and frame[1] in _TYPES and sum(frame[:-1]) & 0xFF == frame[-1]:
                found += self._gap()
                at += SIZE
                w, x, y, z = _BODY.unpack_from(frame)[2:]
                found.append(WitFrame(frame[1], (w, x, y, z), start + at))
                self.frames += 1
            else:  # a good frame may begin inside a bad one: move on by one byte, not by eleven
                at += 1
                self._skipped += 1
                self.discarded += 1
        self._pending = buffer[at:]
        return found

    def flush(self) -> list[WitFrame | CorruptBytes]:
        """Give up waiting: what is pending is shorter than a frame, so none hides in it."""
        self._skipped += len(self._pending)
        self.discarded += len(self._pending)
        self._pending = b""
        return [*self._gap()]

    @property
    def pending(self) -> int:
        """Bytes that wait for the rest of a frame."""
        return len(self._pending)

    def _gap(self) -> list[CorruptBytes]:
        skipped, self._skipped = self._skipped, 0
        return [CorruptBytes(skipped, "no frame starts here")] if skipped else []
