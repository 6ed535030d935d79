"""LP-BUS messages of LP-Research sensors on a serial line.

     0     1-2   3-4       5-6   7 .. 6+n   7+n, 8+n   9+n   10+n
    | 3A | id  | command | n   | data ... | LRC      | 0D  | 0A  |      n <= 1024

Numbers are little-endian. LRC is the 16-bit sum of identifier, command, n and data. Two readings of
the vendor's documents exist: the sum of the bytes, and the sum of 16-bit words in the head. They
agree while all three numbers are below 256. Both are accepted, the sum of the bytes is sent.

Source: protocol pages of the vendor's knowledge base; OpenZen (MIT) for the two sums.

Invariant: bytes in, messages out; no port, no clock.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes

MAX_DATA = 1024
"""Most bytes of data. It bounds the wait after a corrupt length."""
OVERHEAD = 11
"""Bytes of a message besides its data."""
MAX_MESSAGE = MAX_DATA + OVERHEAD
_START = 0x3A
_END = b"\r\n"
_HEAD = 7
_TAIL = 4
_RUN = MAX_MESSAGE
"""Bytes of noise after which a run is reported, so that the sum of corrupt bytes is up to date."""
_CARRY = 0xFF
"""Difference of the two sums for each unit of a high byte in the head."""
_HEADER = struct.Struct("<BHHH")
_LRC = struct.Struct("<H")


class LpBusMessage(NamedTuple):
    """One message with a valid sum."""

    sensor_id: int
    command: int
    data: bytes
    end: int = 0
    """Bytes fed to the decoder up to and including the message, for back-dating."""

    @property
    def size(self) -> int:
        """Bytes on the wire."""
        return len(self.data) + OVERHEAD


def encode(command: int, data: bytes = b"", sensor_id: int = 1) -> bytes:
    """Return the message on the wire, with the sum of the bytes.

    Raises
    ------
    ValueError
        `data` is longer than 1024 bytes, or `command` or `sensor_id` has more than 16 bits.
    """
    if len(data) > MAX_DATA:
        raise ValueError(f"{len(data)} bytes of data: an LP-BUS message holds {MAX_DATA}")
    try:
        head = _HEADER.pack(_START, sensor_id, command, len(data))
    except struct.error:
        raise ValueError(
            f"sensor id {sensor_id}, command {command}: expected 0 to 65535 each"
        ) from None
    lrc = (sum(head) - _START + sum(data)) & 0xFFFF
    return head + data + _LRC.pack(lrc) + _END


class LpBusCodec:
    """Decoder of pieces of any size to messages; the result does not depend on the pieces.

    A run of bytes without a message becomes one `CorruptBytes`: before the message that ends it, at
    `flush`, or every 1035 bytes.
    """

    def __init__(self) -> None:
        self._pending = b""  # under one message between calls: MAX_MESSAGE bounds it
        self.fed = 0
        """Bytes fed so far."""
        self._run = 0
        self._reason = ""
        self.messages = 0
        """Messages so far."""
        self.discarded = 0
        """Bytes without a message so far."""
        self.checksum_failures = 0
        """Complete candidates with a wrong sum so far."""

    @property
    def pending(self) -> int:
        """Bytes of an incomplete message."""
        return len(self._pending)

    def feed(self, data: bytes) -> list[LpBusMessage | CorruptBytes]:
        """Return the messages that `data` completed, in wire order; never raises."""
        return self._scan(data, final=False)

    def flush(self) -> list[LpBusMessage | CorruptBytes]:
        """End the input, or a silence: return messages hidden in the pending bytes."""
        found = self._scan(b"", final=True)
        self._end_run(found)
        return found

    def _scan(self, data: bytes, *, final: bool) -> list[LpBusMessage | CorruptBytes]:
        buffer = self._pending + data if self._pending else bytes(data)
        base = self.fed - len(self._pending)
        self.fed += len(data)
        found: list[LpBusMessage | CorruptBytes] = []

        at, end = 0, len(buffer)
        while at < end:
            if buffer[at] != _START:
                after = buffer.find(_START, at)
                after = end if after < 0 else after
                self._skip(after - at, _NO_START, found)
                at = after
                continue

            size, sensor_id, command = _HEAD, 0, 0
            if at + _HEAD <= end:
                _, sensor_id, command, length = _HEADER.unpack_from(buffer, at)
                size = length + OVERHEAD if length <= MAX_DATA else _HEAD
            if at + size > end and not final:
                break

            reason = _fault(buffer, at, size)
            if reason:  # a valid message may start inside a corrupt one: skip one byte only
                self._skip(1, reason, found)
                at += 1
                continue

            if self._run:
                self._end_run(found)
            body = buffer[at + _HEAD : at + size - _TAIL]
            at += size
            found.append(LpBusMessage(sensor_id, command, body, base + at))
            self.messages += 1
        self._pending = buffer[at:]
        return found

    def _skip(self, count: int, reason: str, found: list[LpBusMessage | CorruptBytes]) -> None:
        """Count bytes without a message; the first fault names the run."""
        self.discarded += count
        self.checksum_failures += reason == _CHECKSUM
        if self._run == 0 or self._reason == _NO_START:
            self._reason = reason
        self._run += count
        while self._run >= _RUN:
            found.append(CorruptBytes(_RUN, self._reason))
            self._run -= _RUN
            self._reason = reason

    def _end_run(self, found: list[LpBusMessage | CorruptBytes]) -> None:
        if self._run:
            found.append(CorruptBytes(self._run, self._reason))
            self._run = 0


_NO_START = "no message starts here"
_CHECKSUM = "checksum"
_TERMINATOR = "terminator is not CR LF"
_LENGTH = "length above 1024"
_CUT_OFF = "cut off"


def _fault(buffer: bytes, at: int, size: int) -> str:
    """Return the reason why no message of `size` bytes starts at `at`; empty if one does."""
    if at + size > len(buffer):
        return _CUT_OFF
    if size == _HEAD:
        return _LENGTH
    tail = at + size
    if buffer[tail - 2 : tail] != _END:
        return _TERMINATOR

    by_bytes = sum(buffer[at + 1 : tail - _TAIL])
    lrc = buffer[tail - 4] | buffer[tail - 3] << 8
    if (by_bytes - lrc) & 0xFFFF:
        # a vendor program sums identifier, command and length as words of 16 bits
        by_words = by_bytes + _CARRY * (buffer[at + 2] + buffer[at + 4] + buffer[at + 6])
        if (by_words - lrc) & 0xFFFF:
            return _CHECKSUM
    return ""
