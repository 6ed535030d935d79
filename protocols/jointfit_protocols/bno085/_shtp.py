"""Packets of the Sensor Hub Transport Protocol (SHTP) over UART (mode UART-SHTP, 3 Mbaud).

    7E | 01 | length, 2 bytes | channel | sequence | payload ... | 7E      packet
    7E | 00 | available, 2 bytes | 7E                                     buffer status
    7E | 00 | 7E                                                          query of the status

Inside a frame, 7E and 7D are sent as 7D followed by the byte with bit 5 inverted. The length
includes the four bytes of the header. Bit 15 of the length field marks a continuation. There is no
checksum. A packet is valid if its length field agrees with the length of the frame. Adjacent frames
may share a flag (7E). Numbers are little-endian.

Sources: BNO08X data sheet 1000-3927, section 1.3.1; SH-2 SHTP reference manual 1000-3600; for the
control protocol, the vendor's host library (sh2, Apache-2.0).

Invariant: the codec converts bytes to packets. It uses no port and no clock.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes

FLAG, ESCAPE = 0x7E, 0x7D
_FLAG, _ESCAPE = bytes((FLAG,)), bytes((ESCAPE,))
_INVERTED = 0x20
_CONTROL, _SHTP = 0x00, 0x01
_HEADER = struct.Struct("<HBB")
_LENGTH = 0x7FFF
_HEAD = 1 + _HEADER.size
_STATUS_BYTES = 3
MOST_PAYLOAD = 2044
"""Longest accepted payload, bytes. The longest known payload is an advertisement of 276 bytes. The
limit bounds the wait after a lost flag."""
_MOST_SEGMENT = 2 * (_HEAD + MOST_PAYLOAD)
"""Longest frame if every byte is escaped, bytes."""


class ShtpChannel(IntEnum):
    """Channels of the sensor hub."""

    COMMAND = 0
    """Advertisement that the device sends after a reset."""
    EXECUTABLE = 1
    CONTROL = 2
    """Requests and their replies."""
    INPUT = 3
    """Sensor reports."""
    WAKE_INPUT = 4
    GYRO_ROTATION = 5


class ShtpPacket(NamedTuple):
    """One packet whose length field agrees with the length of its frame."""

    channel: int
    sequence: int
    """Sequence number of the packet for its channel and direction, modulo 256."""
    payload: bytes
    size: int = 0
    """Length on the wire, including both flags, bytes."""
    end: int = 0
    """Number of bytes fed to the codec until the end of the closing flag. Drivers compute the
    arrival time of the first byte from this number."""


class ShtpBufferStatus(NamedTuple):
    """Answer to a query, with the number of bytes that the device accepts now."""

    available: int
    size: int = 0
    end: int = 0


Shtp = ShtpPacket | ShtpBufferStatus | CorruptBytes


def encode_shtp(channel: int, sequence: int, payload: bytes) -> bytes:
    """Return the bytes of a packet on the wire, including both flags.

    Raises
    ------
    ValueError
        `payload` is longer than `MOST_PAYLOAD`.
    """
    if len(payload) > MOST_PAYLOAD:
        raise ValueError(f"{len(payload)} bytes: an SHTP packet holds at most {MOST_PAYLOAD}")
    header = _HEADER.pack(len(payload) + _HEADER.size, channel, sequence & 0xFF)
    return _encode_frame(_SHTP, header + payload)


def encode_status(available: int | None) -> bytes:
    """Return a buffer status on the wire, or, if `available` is None, the query for the status."""
    return _encode_frame(_CONTROL, b"" if available is None else available.to_bytes(2, "little"))


def _encode_frame(protocol: int, data: bytes) -> bytes:
    body = bytes((protocol,)) + data
    body = body.replace(_ESCAPE, bytes((ESCAPE, ESCAPE ^ _INVERTED)))
    return _FLAG + body.replace(_FLAG, bytes((ESCAPE, FLAG ^ _INVERTED))) + _FLAG


class ShtpCodec:
    """Codec that converts a byte stream to packets; the stream may be split at any position.

    If the bytes between two flags form neither a packet nor a buffer status, they become one
    `CorruptBytes`. Flags are counted separately.
    """

    def __init__(self) -> None:
        self._pending = b""  # at most `_MOST_SEGMENT` bytes between calls
        self._lost_flag = False  # the rest up to the next flag belongs to a frame that is too long
        self._started = False
        self.fed = 0
        """Number of bytes fed so far."""
        self.messages = 0
        """Number of packets so far."""
        self.statuses = 0
        """Number of buffer statuses so far."""
        self.flags = 0
        """Number of flags so far."""
        self.discarded = 0
        """Number of bytes so far that belong to no packet."""

    @property
    def pending(self) -> int:
        """Number of bytes of the incomplete frame in the buffer."""
        return len(self._pending)

    def feed(self, data: bytes) -> list[Shtp]:
        """Return the packets that `data` completes, in wire order; never raise."""
        *segments, rest = (self._pending + data).split(_FLAG)
        end = self.fed - len(self._pending)
        self.fed += len(data)
        found: list[Shtp] = []
        for segment in segments:
            end += len(segment) + 1
            self.flags += 1
            if segment:
                found.append(self._decode(segment, end))
            self._lost_flag, self._started = False, True

        self._pending = rest
        while len(self._pending) > _MOST_SEGMENT:
            self._lost_flag = True
            found.append(self._corrupt(_MOST_SEGMENT, "no flag"))
            self._pending = self._pending[_MOST_SEGMENT:]
        return found

    def flush(self) -> list[Shtp]:
        """Discard an incomplete frame, because its end was lost."""
        pending, self._pending = len(self._pending), b""
        self._lost_flag = self._lost_flag or pending > 0
        return [self._corrupt(pending, "cut off")] if pending else []

    def _decode(self, segment: bytes, end: int) -> Shtp:
        if self._lost_flag or not self._started:
            return self._corrupt(len(segment), "no frame starts here")
        data = _unescape(segment)
        if data is None:
            return self._corrupt(len(segment), "escape without byte")

        if data[0] == _CONTROL and len(data) == _STATUS_BYTES:
            self.statuses += 1
            available = int.from_bytes(data[1:], "little")
            return ShtpBufferStatus(available, len(segment) + 2, end)
        if data[0] != _SHTP or len(data) < _HEAD:
            return self._corrupt(len(segment), "neither a packet nor a buffer status")
        length, channel, sequence = _HEADER.unpack_from(data, 1)
        if length & _LENGTH != len(data) - 1:
            return self._corrupt(len(segment), "length")
        self.messages += 1
        return ShtpPacket(channel, sequence, data[_HEAD:], len(segment) + 2, end)

    def _corrupt(self, count: int, reason: str) -> CorruptBytes:
        self.discarded += count
        return CorruptBytes(count, reason)


def _unescape(segment: bytes) -> bytes | None:
    """Return the bytes of a frame; None if an escape is last or directly before another escape."""
    if ESCAPE not in segment:
        return segment
    first, *rest = segment.split(_ESCAPE)
    if not all(rest):
        return None
    return first + b"".join(bytes((part[0] ^ _INVERTED,)) + part[1:] for part in rest)
