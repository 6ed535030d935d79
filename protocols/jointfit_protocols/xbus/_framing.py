"""Xbus messages of Xsens / Movella devices on a UART.

     0    1     2     3     4        4+LEN
    | FA | BID | MID | LEN | data ... | CS |
     0    1     2     3    4           6        6+n
    | FA | BID | MID | FF | n, 2 bytes | data ... | CS |      extended, n = 255..2048

All bytes after FA, the checksum included, sum to 0 mod 256. LEN is 0..254. Numbers are big-endian.

Source: MT0101P, MT Low Level Communication Protocol Documentation, rev. 2020.A.

Invariant: bytes in, messages out; no port, no clock.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes

PREAMBLE = 0xFA
MASTER = 0xFF
"""BID of a stand-alone device, and of every unsolicited message."""
MAX_DATA = 2048
"""Most bytes of data, by the vendor's documents. It bounds the wait after a corrupt length."""
MAX_MESSAGE = MAX_DATA + 7
_EXTENDED = 0xFF
_HEAD = 4
_RUN = MAX_MESSAGE
"""Bytes of noise after which a run is reported, so that the sum of corrupt bytes is up to date."""


class XbusMessageId(IntEnum):
    """Message identifiers; a reply is its request plus one."""

    REQ_DEVICE_ID = 0x00
    DEVICE_ID = 0x01
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
    CAN_CONFIG = 0xE6
    CAN_CONFIG_ACK = 0xE7
    CAN_OUTPUT = 0xE8
    CAN_OUTPUT_ACK = 0xE9
    ALIGNMENT_ROTATION = 0xEC
    ALIGNMENT_ROTATION_ACK = 0xED


class XbusMessage(NamedTuple):
    """One message with a valid checksum."""

    mid: int
    data: bytes
    bid: int = MASTER
    end: int = 0
    """Bytes fed to the decoder up to and including the checksum, for back-dating."""

    @property
    def size(self) -> int:
        """Bytes on the wire."""
        return len(self.data) + (5 if len(self.data) < _EXTENDED else 7)


def encode(mid: int, data: bytes = b"", bid: int = MASTER) -> bytes:
    """Return the message on the wire.

    Raises
    ------
    ValueError
        `data` is longer than 2048 bytes.
    """
    if len(data) > MAX_DATA:
        raise ValueError(f"{len(data)} bytes of data: an Xbus message holds {MAX_DATA}")
    if len(data) < _EXTENDED:
        body = bytes((bid, mid, len(data))) + data
    else:
        body = bytes((bid, mid, _EXTENDED)) + len(data).to_bytes(2, "big") + data
    return bytes((PREAMBLE,)) + body + bytes((-sum(body) & 0xFF,))


class XbusCodec:
    """Decoder of pieces of any size to messages; the result does not depend on the pieces.

    A run of bytes without a message becomes one `CorruptBytes`: before the message that ends it, at
    `flush`, or every 2055 bytes.
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
        """Complete candidates with a wrong checksum so far."""

    @property
    def pending(self) -> int:
        """Bytes of an incomplete message."""
        return len(self._pending)

    def feed(self, data: bytes) -> list[XbusMessage | CorruptBytes]:
        """Return the messages that `data` completed, in wire order; never raises."""
        return self._scan(data, final=False)

    def flush(self) -> list[XbusMessage | CorruptBytes]:
        """End the input, or a silence: return messages hidden in the pending bytes."""
        found = self._scan(b"", final=True)
        self._end_run(found)
        return found

    def _scan(self, data: bytes, *, final: bool) -> list[XbusMessage | CorruptBytes]:
        buffer = self._pending + data if self._pending else bytes(data)
        base = self.fed - len(self._pending)
        self.fed += len(data)
        found: list[XbusMessage | CorruptBytes] = []

        at, end = 0, len(buffer)
        while at < end:
            size = _size(buffer, at)
            if at + size > end and not final:
                break
            reason = _fault(buffer, at, size)
            if not reason:
                if self._run:
                    self._end_run(found)
                head = at + (_HEAD if buffer[at + 3] != _EXTENDED else _HEAD + 2)
                data = buffer[head : at + size - 1]
                found.append(XbusMessage(buffer[at + 2], data, buffer[at + 1], base + at + size))
                self.messages += 1
                at += size
            elif reason == _NO_START:
                after = buffer.find(PREAMBLE, at)
                after = end if after < 0 else after
                self._skip(after - at, reason, found)
                at = after
            else:  # a valid message may start inside a corrupt one: skip one byte only
                self._skip(1, reason, found)
                at += 1
        self._pending = buffer[at:]
        return found

    def _skip(self, count: int, reason: str, found: list[XbusMessage | CorruptBytes]) -> None:
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

    def _end_run(self, found: list[XbusMessage | CorruptBytes]) -> None:
        if self._run:
            found.append(CorruptBytes(self._run, self._reason))
            self._run = 0


_NO_START = "no message starts here"
_CHECKSUM = "checksum"
_LENGTH = "length outside 255..2048"
_CUT_OFF = "cut off"


def _size(buffer: bytes, at: int) -> int:
    """Return the bytes from `at` that are needed to decide about a message there."""
    if buffer[at] != PREAMBLE:
        return 1

    have = len(buffer) - at
    if have < _HEAD:
        return _HEAD

    length = buffer[at + 3]
    if length != _EXTENDED:
        return length + _HEAD + 1
    if have < _HEAD + 2:
        return _HEAD + 2
    length = buffer[at + 4] << 8 | buffer[at + 5]
    return length + _HEAD + 3 if _EXTENDED <= length <= MAX_DATA else _HEAD + 2


def _fault(buffer: bytes, at: int, size: int) -> str:
    """Return the reason why no message of `size` bytes starts at `at`; empty if one does."""
    if buffer[at] != PREAMBLE:
        return _NO_START
    if at + size > len(buffer):
        return _CUT_OFF
    if size == _HEAD + 2 and buffer[at + 3] == _EXTENDED:
        return _LENGTH
    if sum(buffer[at + 1 : at + size]) & 0xFF:
        return _CHECKSUM
    return ""
