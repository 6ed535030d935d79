"""LP-BUS messages of LP-Research sensors on a serial line.

     0     1-2   3-4       5-6   7 .. 6+n   7+n, 8+n   9+n   10+n
    | 3A | id  | command | n   | data ... | LRC      | 0D  | 0A  |      n <= 1024

Numbers are little-endian. The checksum LRC is the 16-bit sum of id, command, n and data. The
vendor's documents permit two interpretations: the sum of all bytes, or the sum of the 16-bit words
of the head and the bytes of the data. Both sums are equal if id, command and n are below 256.
The codec accepts both, and sends the sum of the bytes.

Source: protocol pages of the vendor's knowledge base; OpenZen (MIT) for the two sums.

Invariant: the codec converts bytes to messages. It uses no port and no clock.
"""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

from jointfit_protocols.corrupt import CHECKSUM, NO_START, CorruptBytes
from jointfit_protocols.resynchronizing_codec import ResynchronizingCodec

MAX_DATA = 1024
"""Largest number of data bytes. The limit bounds the wait after a corrupt length."""
OVERHEAD = 11
"""Length of a message without its data, bytes."""
MAX_MESSAGE = MAX_DATA + OVERHEAD
_START = 0x3A
_END = b"\r\n"
_HEAD = 7
_TAIL = 4
_CARRY = 0xFF
"""Difference between the two sums for each unit of a high byte in the head."""
_HEADER = struct.Struct("<BHHH")
_LRC = struct.Struct("<H")


class LpBusMessage(NamedTuple):
    """One message whose sum is correct."""

    sensor_id: int
    command: int
    data: bytes
    end: int = 0
    """Number of bytes fed to the codec until the end of the message. Drivers compute the
    arrival time of the first byte from this number."""

    @property
    def size(self) -> int:
        """Length of the message on the wire, bytes."""
        return len(self.data) + OVERHEAD


def encode(command: int, data: bytes = b"", sensor_id: int = 1) -> bytes:
    """Return the bytes of a message on the wire; the checksum is the sum of the bytes.

    Raises
    ------
    ValueError
        `data` is longer than 1024 bytes, or `command` or `sensor_id` has more than 16 bits.
    """
    if len(data) > MAX_DATA:
        raise ValueError(f"{len(data)} bytes of data: an LP-BUS message holds at most {MAX_DATA}")
    try:
        head = _HEADER.pack(_START, sensor_id, command, len(data))
    except struct.error:
        raise ValueError(
            f"sensor id {sensor_id}, command {command}: expected 0 to 65535 each"
        ) from None
    lrc = (sum(head) - _START + sum(data)) & 0xFFFF
    return head + data + _LRC.pack(lrc) + _END


_AT_START = re.compile(b"\x3a")
_NO_START = CorruptBytes(1, NO_START)
_CHECKSUM = CorruptBytes(1, CHECKSUM)
_TERMINATOR = CorruptBytes(1, "terminator is not CR LF")
_LENGTH = CorruptBytes(1, "length above 1024")


def _read_message(buffer: bytes, at: int, base: int) -> LpBusMessage | CorruptBytes | None:  # noqa: PLR0911 - one return for each fault
    """Return the message at `at`, the reason why there is none, or None if it is incomplete."""
    if buffer[at] != _START:
        return _NO_START

    head = at + _HEAD
    if head > len(buffer):
        return None
    _, sensor_id, command, length = _HEADER.unpack_from(buffer, at)
    if length > MAX_DATA:
        return _LENGTH

    tail = head + length
    after = tail + _TAIL
    if after > len(buffer):
        return None
    if buffer[after - 2 : after] != _END:
        return _TERMINATOR

    by_bytes = sum(buffer[at + 1 : tail])
    lrc = buffer[tail] | buffer[tail + 1] << 8
    if (by_bytes - lrc) & 0xFFFF:
        # One of the vendor's programs sums identifier, command and length as words of 16 bits.
        by_words = by_bytes + _CARRY * (buffer[at + 2] + buffer[at + 4] + buffer[at + 6])
        if (by_words - lrc) & 0xFFFF:
            return _CHECKSUM
    return LpBusMessage(sensor_id, command, buffer[head:tail], base + after)


class LpBusCodec(ResynchronizingCodec[LpBusMessage]):
    """Codec that converts a byte stream to messages; the stream may be split at any position.

    Runs of corrupt bytes are reported after at most 1035 bytes.
    """

    def __init__(self) -> None:
        super().__init__(_read_message, _AT_START, MAX_MESSAGE)
