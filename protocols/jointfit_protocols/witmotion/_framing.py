"""Frames of WitMotion IMUs on a UART.

     0    1      2 .. 9            10
    | 55 | kind | 8 bytes of data | sum of bytes 0..9 mod 256 |      kind 50..5F, 11 bytes

Bluetooth and SD models send another variant: 55 61 and 18 or 26 bytes of data without a checksum.
This variant contains no quaternion. Its frames are only counted.

Source: protocol pages of the vendor (Standard Communication Protocol).

Invariant: the codec converts bytes to frames. It uses no port and no clock.
"""

from __future__ import annotations

import re
from enum import IntEnum
from typing import NamedTuple

from jointfit_protocols.corrupt import CHECKSUM, CorruptBytes
from jointfit_protocols.resynchronizing_codec import ResynchronizingCodec

FRAME_BYTES = 11
"""Length of every frame, bytes."""
_START = 0x55
_FIRST_KIND, _LAST_KIND = 0x50, 0x5F
_OTHER_KIND = 0x61
_OTHER_SIZES = (20, 28)
"""Distances between the starts of 55 61 frames, bytes."""
_RUN = 1024
"""Number of noise bytes after which a run is reported, so that the number of corrupt bytes is up to
date."""
_AT_START = re.compile(b"\x55")
_NO_START = CorruptBytes(1, "no frame starts here")
_CHECKSUM = CorruptBytes(1, CHECKSUM)


class WitMotionFrameKind(IntEnum):
    """Kind of a frame, which is its second byte."""

    TIME = 0x50
    ACCELERATION = 0x51
    RATE = 0x52
    ANGLE = 0x53
    MAGNETIC_FIELD = 0x54
    PORT = 0x55
    PRESSURE = 0x56
    POSITION = 0x57
    VELOCITY = 0x58
    QUATERNION = 0x59
    SATELLITES = 0x5A
    REGISTERS = 0x5F
    """Reply to a read command, with four registers."""


class WitMotionFrame(NamedTuple):
    """One frame whose checksum is correct."""

    kind: int
    data: bytes
    """Eight bytes of data."""
    end: int = 0
    """Number of bytes fed to the codec until the end of the checksum. Drivers compute the
    arrival time of the first byte from this number."""


def encode(kind: int, data: bytes) -> bytes:
    """Return the bytes of a frame on the wire.

    Raises
    ------
    ValueError
        `data` does not have 8 bytes, or `kind` is not 0x50 to 0x5F.
    """
    if len(data) != FRAME_BYTES - 3 or not _FIRST_KIND <= kind <= _LAST_KIND:
        raise ValueError(f"frame 0x{kind:02X} with {len(data)} bytes: expected 0x50..0x5F, 8 bytes")
    body = bytes((_START, kind)) + data
    return body + bytes((sum(body) & 0xFF,))


class WitMotionCodec(ResynchronizingCodec[WitMotionFrame]):
    """Codec that converts a byte stream to frames; the stream may be split at any position.

    Runs of corrupt bytes are reported after at most 1024 bytes.
    """

    def __init__(self) -> None:
        super().__init__(self._read_frame, _AT_START, _RUN, _NO_START.reason, FRAME_BYTES)
        self._other_at = -1 - max(_OTHER_SIZES)  # too far from the first frame to be counted
        self.other_frames = 0
        """Number of frames of the variant 55 61 so far. The variant is not decoded."""

    def _read_frame(
        self, buffer: bytes, at: int, base: int
    ) -> WitMotionFrame | CorruptBytes | None:
        if buffer[at] != _START:
            return _NO_START
        after = at + FRAME_BYTES
        if after > len(buffer):
            return None

        kind = buffer[at + 1]
        if not _FIRST_KIND <= kind <= _LAST_KIND:
            if kind == _OTHER_KIND:
                self.other_frames += base + at - self._other_at in _OTHER_SIZES
                self._other_at = base + at
            return _NO_START
        if sum(buffer[at : after - 1]) & 0xFF != buffer[after - 1]:
            return _CHECKSUM
        return WitMotionFrame(kind, buffer[at + 2 : after - 1], base + after)
