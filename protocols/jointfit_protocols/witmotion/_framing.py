"""Frames of WitMotion IMUs on a UART.

     0    1      2 .. 9            10
    | 55 | kind | 8 bytes of data | sum of bytes 0..9 mod 256 |      kind 50..5F, 11 bytes

Bluetooth and SD models send another variant, 55 61 and 18 or 26 bytes of data without a checksum.
It contains no quaternion and is recognised only.

Source: protocol pages of the vendor (Standard Communication Protocol).

Invariant: bytes in, frames out; no port, no clock.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes

FRAME_BYTES = 11
"""Bytes of every frame."""
_START = 0x55
_FIRST_KIND, _LAST_KIND = 0x50, 0x5F
_OTHER_KIND = 0x61
_OTHER_SIZES = (20, 28)
"""Distances between the starts of 55 61 frames, bytes."""
_RUN = 1024
"""Bytes of noise after which a run is reported, so that the sum of corrupt bytes is up to date."""
_NO_START = "no frame starts here"
_CHECKSUM = "checksum"


class WitMotionFrameKind(IntEnum):
    """Second byte of a frame."""

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
    """Reply to a read command: four registers."""


class WitMotionFrame(NamedTuple):
    """One frame with a valid checksum."""

    kind: int
    data: bytes
    """Eight bytes."""
    end: int = 0
    """Bytes fed to the codec up to and including the checksum, for back-dating."""


def encode(kind: int, data: bytes) -> bytes:
    """Return the frame on the wire.

    Raises
    ------
    ValueError
        `data` does not have 8 bytes, or `kind` is not 0x50 to 0x5F.
    """
    if len(data) != FRAME_BYTES - 3 or not _FIRST_KIND <= kind <= _LAST_KIND:
        raise ValueError(f"frame 0x{kind:02X} with {len(data)} bytes: expected 0x50..0x5F, 8 bytes")
    body = bytes((_START, kind)) + data
    return body + bytes((sum(body) & 0xFF,))


class WitMotionCodec:
    """Decoder of pieces of any size to frames; the result does not depend on the pieces.

    A run of bytes without a frame becomes one `CorruptBytes`: before the frame that ends it, at
    `flush`, or every 1024 bytes.
    """

    def __init__(self) -> None:
        self._pending = b""  # under one frame between calls
        self._run = 0
        self._reason = ""
        self._other_at = -1
        self.fed = 0
        """Bytes fed so far."""
        self.frames = 0
        """Frames so far."""
        self.discarded = 0
        """Bytes without a frame so far."""
        self.checksum_failures = 0
        """Complete candidates with a wrong checksum so far."""
        self.other_frames = 0
        """Frames so far of the variant 55 61, which is not decoded."""

    @property
    def pending(self) -> int:
        """Bytes of an incomplete frame."""
        return len(self._pending)

    def feed(self, data: bytes) -> list[WitMotionFrame | CorruptBytes]:
        """Return the frames that `data` completed, in wire order; never raises."""
        buffer = self._pending + data if self._pending else bytes(data)
        base = self.fed - len(self._pending)
        self.fed += len(data)
        found: list[WitMotionFrame | CorruptBytes] = []

        at, end = 0, len(buffer)
        last = end - FRAME_BYTES
        while at < end:
            if buffer[at] != _START:
                after = buffer.find(_START, at)
                after = end if after < 0 else after
                self._skip(after - at, _NO_START, found)
                at = after
                continue
            if at > last:
                break

            reason = _NO_START
            if _FIRST_KIND <= buffer[at + 1] <= _LAST_KIND:
                if sum(buffer[at : at + 10]) & 0xFF == buffer[at + 10]:
                    if self._run:
                        self._end_run(found)
                    done = at + FRAME_BYTES
                    data = buffer[at + 2 : done - 1]
                    found.append(WitMotionFrame(buffer[at + 1], data, base + done))
                    self.frames += 1
                    at = done
                    continue
                self.checksum_failures += 1
                reason = _CHECKSUM
            elif buffer[at + 1] == _OTHER_KIND:
                self.other_frames += base + at - self._other_at in _OTHER_SIZES
                self._other_at = base + at

            # A valid frame may start inside a corrupt one: skip one byte only.
            self._skip(1, reason, found)
            at += 1

        self._pending = buffer[at:]
        return found

    def flush(self) -> list[WitMotionFrame | CorruptBytes]:
        """End the input, or a silence: pending bytes are fewer than a frame and contain none."""
        found: list[WitMotionFrame | CorruptBytes] = []
        if self._pending:
            self._skip(len(self._pending), "cut off", found)
            self._pending = b""
        if self._run:
            self._end_run(found)
        return found

    def _skip(self, count: int, reason: str, found: list[WitMotionFrame | CorruptBytes]) -> None:
        """Count bytes without a frame; the first fault names the run."""
        self.discarded += count
        if self._run == 0 or self._reason == _NO_START:
            self._reason = reason
        self._run += count
        while self._run >= _RUN:
            found.append(CorruptBytes(_RUN, self._reason))
            self._run -= _RUN
            self._reason = reason

    def _end_run(self, found: list[WitMotionFrame | CorruptBytes]) -> None:
        found.append(CorruptBytes(self._run, self._reason))
        self._run = 0
