"""Codec of WitMotion frames on a UART: bytes to register counts and back.

Invariant: the codec has no port, no clock and no units.

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
"""Value of one count of a quaternion."""
SIZE = 11
"""Length of a frame, bytes."""
UNLOCK = bytes.fromhex("ffaa6988b5")
"""Command that allows write access to the registers for 10 s."""
SAVE = bytes.fromhex("ffaa000000")
"""Command that stores the registers in flash."""
CONTENT, RATE = 0x02, 0x03
"""Registers: frame types to send, and rate."""
CONTENT_QUATERNION = 1 << 9
"""Bit of the register CONTENT."""
RATES = {10: 0x06, 20: 0x07, 50: 0x08, 100: 0x09, 200: 0x0B}
"""Values of the register RATE, by rate in Hz."""
OTHER_VARIANT = b"\x55\x61"
"""Start of frames of Bluetooth and SD models, which have neither checksum nor quaternion."""

_BODY = struct.Struct("<BB4h")
_START = 0x55
_TYPES = range(0x50, 0x60)


class WitFrame(NamedTuple):
    """One frame with a valid checksum."""

    kind: int
    counts: tuple[int, int, int, int]
    end: int = 0
    """Number of bytes fed to the codec up to the end of the frame, for back-dating."""


def encode(kind: int, counts: tuple[int, int, int, int]) -> bytes:
    """Return the bytes of a frame."""
    body = _BODY.pack(_START, kind, *counts)
    return body + bytes((sum(body) & 0xFF,))


def write_register(register: int, value: int) -> bytes:
    """Return the command that writes `value`; it takes effect only after `UNLOCK`."""
    return struct.pack("<BBBH", 0xFF, 0xAA, register, value)


class WitCodec:
    """Converts bytes, in pieces of any size, to frames."""

    def __init__(self) -> None:
        self._pending = b""  # always shorter than a frame between calls
        self._skipped = 0
        self.fed = 0
        """Number of bytes fed."""
        self.frames = 0
        """Number of frames returned."""
        self.discarded = 0
        """Number of bytes that belong to no frame."""

    def feed(self, data: bytes) -> list[WitFrame | CorruptBytes]:
        """Return the frames completed by `data`, in wire order; never raises."""
        buffer, start = self._pending + data, self.fed - len(self._pending)
        self.fed += len(data)

        found: list[WitFrame | CorruptBytes] = []
        at = 0
        while len(buffer) - at >= SIZE:
            frame = buffer[at : at + SIZE]
            if frame[0] == _START and frame[1] in _TYPES and sum(frame[:-1]) & 0xFF == frame[-1]:
                found += self._corrupt()
                at += SIZE
                w, x, y, z = _BODY.unpack_from(frame)[2:]
                found.append(WitFrame(frame[1], (w, x, y, z), start + at))
                self.frames += 1
            else:
                # a valid frame may begin inside an invalid one: skip one byte, not eleven
                at += 1
                self._skipped += 1
                self.discarded += 1

        self._pending = buffer[at:]
        return found

    def flush(self) -> list[WitFrame | CorruptBytes]:
        """Discard pending bytes; they are shorter than a frame and contain none."""
        self._skipped += len(self._pending)
        self.discarded += len(self._pending)
        self._pending = b""
        return [*self._corrupt()]

    @property
    def pending(self) -> int:
        """Number of bytes of an incomplete frame."""
        return len(self._pending)

    def _corrupt(self) -> list[CorruptBytes]:
        """Return the skipped bytes as an event, if any, and reset their number."""
        skipped, self._skipped = self._skipped, 0
        return [CorruptBytes(skipped, "no frame starts here")] if skipped else []
