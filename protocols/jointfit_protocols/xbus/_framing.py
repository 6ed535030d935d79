"""Xbus messages of Xsens / Movella devices on a UART.

     0    1     2     3     4        4+LEN
    | FA | BID | MID | LEN | data ... | CS |
     0    1     2     3    4           6        6+n
    | FA | BID | MID | FF | n, 2 bytes | data ... | CS |      extended, n = 255..2048

The sum of all bytes after FA, including the checksum, is 0 mod 256. LEN is 0..254. Numbers are
big-endian.

Source: MT0101P, MT Low Level Communication Protocol Documentation, rev. 2020.A.

Invariant: the codec converts bytes to messages. It uses no port and no clock.
"""

from __future__ import annotations

import re
from enum import IntEnum
from typing import NamedTuple

from jointfit_protocols.corrupt import CHECKSUM, NO_START, CorruptBytes
from jointfit_protocols.resynchronizing_codec import ResynchronizingCodec

PREAMBLE = 0xFA
MASTER = 0xFF
"""Bus identifier (BID) of a stand-alone device and of every unsolicited message."""
MAX_DATA = 2048
"""Largest number of data bytes according to the vendor's documents. The limit bounds the wait after
a corrupt length."""
MAX_MESSAGE = MAX_DATA + 7
_EXTENDED = 0xFF
_HEAD = 4


class XbusMessageId(IntEnum):
    """Message identifiers. The identifier of a reply is the identifier of its request plus one."""

    REQ_DEVICE_ID = 0x00
    DEVICE_ID = 0x01
    PERIOD = 0x04
    PERIOD_ACK = 0x05
    CONFIGURATION = 0x0D
    GOTO_MEASUREMENT = 0x10
    GOTO_MEASUREMENT_ACK = 0x11
    REQ_FIRMWARE = 0x12
    FIRMWARE = 0x13
    BAUDRATE = 0x18
    BAUDRATE_ACK = 0x19
    REQ_PRODUCT_CODE = 0x1C
    PRODUCT_CODE = 0x1D
    SYNC_SETTINGS = 0x2C
    SYNC_SETTINGS_ACK = 0x2D
    GOTO_CONFIG = 0x30
    GOTO_CONFIG_ACK = 0x31
    MT_DATA = 0x32
    MT_DATA2 = 0x36
    WAKE_UP = 0x3E
    WAKE_UP_ACK = 0x3F
    RESET = 0x40
    RESET_ACK = 0x41
    ERROR = 0x42
    WARNING = 0x43
    OPTION_FLAGS = 0x48
    OPTION_FLAGS_ACK = 0x49
    FILTER_PROFILE = 0x64
    FILTER_PROFILE_ACK = 0x65
    PORT_CONFIG = 0x8C
    PORT_CONFIG_ACK = 0x8D
    RESET_ORIENTATION = 0xA4
    RESET_ORIENTATION_ACK = 0xA5
    OUTPUT_CONFIGURATION = 0xC0
    OUTPUT_CONFIGURATION_ACK = 0xC1
    OUTPUT_MODE = 0xD0
    OUTPUT_MODE_ACK = 0xD1
    OUTPUT_SETTINGS = 0xD2
    OUTPUT_SETTINGS_ACK = 0xD3
    OUTPUT_SKIP = 0xD4
    OUTPUT_SKIP_ACK = 0xD5
    CAN_CONFIG = 0xE6
    CAN_CONFIG_ACK = 0xE7
    CAN_OUTPUT = 0xE8
    CAN_OUTPUT_ACK = 0xE9
    ALIGNMENT_ROTATION = 0xEC
    ALIGNMENT_ROTATION_ACK = 0xED


class XbusMessage(NamedTuple):
    """One message whose checksum is correct."""

    mid: int
    data: bytes
    bid: int = MASTER
    end: int = 0
    """Number of bytes fed to the codec until the end of the checksum. Drivers compute the
    arrival time of the first byte from this number."""

    @property
    def size(self) -> int:
        """Length of the message on the wire, bytes."""
        return len(self.data) + (5 if len(self.data) < _EXTENDED else 7)


def encode(mid: int, data: bytes = b"", bid: int = MASTER) -> bytes:
    """Return the bytes of a message on the wire.

    Raises
    ------
    ValueError
        `data` has more than 2048 bytes.
    """
    if len(data) > MAX_DATA:
        raise ValueError(f"{len(data)} bytes of data: an Xbus message holds at most {MAX_DATA}")
    if len(data) < _EXTENDED:
        body = bytes((bid, mid, len(data))) + data
    else:
        body = bytes((bid, mid, _EXTENDED)) + len(data).to_bytes(2, "big") + data
    return bytes((PREAMBLE,)) + body + bytes((-sum(body) & 0xFF,))


_START = re.compile(b"\xfa")
_NO_START = CorruptBytes(1, NO_START)
_CHECKSUM = CorruptBytes(1, CHECKSUM)
_LENGTH = CorruptBytes(1, "length outside 255..2048")


def _read_message(buffer: bytes, at: int, base: int) -> XbusMessage | CorruptBytes | None:  # noqa: PLR0911 - one return for each fault
    """Return the message at `at`, the reason why there is none, or None if it is incomplete."""
    if buffer[at] != PREAMBLE:
        return _NO_START

    have = len(buffer) - at
    if have < _HEAD:
        return None
    head, length = at + _HEAD, buffer[at + 3]
    if length == _EXTENDED:
        if have < _HEAD + 2:
            return None
        head, length = head + 2, buffer[head] << 8 | buffer[head + 1]
        if not _EXTENDED <= length <= MAX_DATA:
            return _LENGTH

    last = head + length
    if last >= len(buffer):
        return None
    if sum(buffer[at + 1 : last + 1]) & 0xFF:
        return _CHECKSUM
    return XbusMessage(buffer[at + 2], buffer[head:last], buffer[at + 1], base + last + 1)


class XbusCodec(ResynchronizingCodec[XbusMessage]):
    """Codec that converts a byte stream to messages; the stream may be split at any position.

    Runs of corrupt bytes are reported after at most 2055 bytes.
    """

    def __init__(self) -> None:
        super().__init__(_read_message, _START, MAX_MESSAGE)
