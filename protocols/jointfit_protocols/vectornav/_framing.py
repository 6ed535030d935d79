"""Messages of VectorNav devices on a serial line: binary outputs among ASCII messages.

    | FA | header | payload | CRC, high byte first |      header and payload: `_layout`
    | $ | content | * | checksum | CR LF |                `_text`

The CRC has the polynomial 0x1021 and begins with 0. It covers header and payload. The length
follows from the header.

Source: VN-100 user manual (UM001), section 5.

Invariant: bytes in, messages out; no port, no clock.
"""

from __future__ import annotations

import re
import struct
from binascii import crc_hqx
from typing import TYPE_CHECKING, Any, NamedTuple

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.vectornav._layout import (
    GROUPS,
    MAX_PAYLOAD,
    BinaryLayout,
    header_bytes,
    layout_of,
)
from jointfit_protocols.vectornav._text import (
    END,
    MAX_TEXT,
    PLAUSIBLE,
    TextMessage,
    decode_text,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

SYNC = 0xFA
_CRC_BYTES = 2
MAX_MESSAGE = 2 + 2 * GROUPS + MAX_PAYLOAD + _CRC_BYTES
"""Size of the largest message, bytes."""
_RUN = MAX_MESSAGE
"""Bytes of noise after which a run is reported, so that the sum of corrupt bytes is up to date."""
_START = re.compile(rb"[\xfa$]")

_NO_START = "no message starts here"
_CHECKSUM = "checksum"
_HEADER = "header unknown to this version"
_TEXT = "malformed text"
_CUT_OFF = "cut off"


class BinaryPacket(NamedTuple):
    """One binary output with a valid CRC."""

    layout: BinaryLayout
    values: tuple[Any, ...]
    """Values of all fields; `BinaryLayout.places` has their places."""
    size: int
    """Bytes on the wire."""
    end: int = 0
    """Bytes fed to the codec up to and including the CRC, for back-dating."""


VectorNavMessage = BinaryPacket | TextMessage


def encode_binary(values: Mapping[int, tuple[Any, ...]]) -> bytes:
    """Return the binary output with these fields on the wire.

    Raises
    ------
    KeyError
        The size of a field is unknown.
    struct.error
        The values do not fit.
    """
    layout = BinaryLayout(values)
    flat = [value for field in layout.fields for value in values[field]]
    body = layout.header + layout.struct.pack(*flat)
    return bytes((SYNC,)) + body + struct.pack(">H", crc_hqx(body, 0))


class VectorNavCodec:
    """Decoder of pieces of any size to messages; the result does not depend on the pieces.

    A run of bytes without a message becomes one `CorruptBytes`: before the message that ends it, at
    `flush`, or every `MAX_MESSAGE` bytes.
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

    @property
    def pending(self) -> int:
        """Bytes of an incomplete message."""
        return len(self._pending)

    def feed(self, data: bytes) -> list[VectorNavMessage | CorruptBytes]:
        """Return the messages that `data` completed, in wire order; never raises."""
        return self._scan(data, final=False)

    def flush(self) -> list[VectorNavMessage | CorruptBytes]:
        """End the input, or a silence: return messages hidden in the pending bytes."""
        found = self._scan(b"", final=True)
        self._end_run(found)
        return found

    def _scan(self, data: bytes, *, final: bool) -> list[VectorNavMessage | CorruptBytes]:
        buffer = self._pending + data if self._pending else bytes(data)
        base = self.fed - len(self._pending)
        self.fed += len(data)
        found: list[VectorNavMessage | CorruptBytes] = []

        at, end = 0, len(buffer)
        while at < end:
            start = _START.search(buffer, at)
            first = end if start is None else start.start()
            if first > at:
                self._skip(first - at, _NO_START, found)
                at = first
                continue

            is_binary = buffer[at] == SYNC
            candidate = _binary(buffer, at, base) if is_binary else _text(buffer, at, base)
            if candidate is None:  # incomplete
                if not final:
                    break
                candidate = _CUT_OFF
            if isinstance(candidate, str):  # a message may start inside a corrupt one
                self._skip(1, candidate, found)
                at += 1
                continue
            if self._run:
                self._end_run(found)
            found.append(candidate)
            self.messages += 1
            at += candidate.size
        self._pending = buffer[at:]
        return found

    def _skip(self, count: int, reason: str, found: list[VectorNavMessage | CorruptBytes]) -> None:
        """Count bytes without a message; the first fault names the run."""
        self.discarded += count
        if self._run == 0 or self._reason == _NO_START:
            self._reason = reason
        self._run += count
        while self._run >= _RUN:
            found.append(CorruptBytes(_RUN, self._reason))
            self._run -= _RUN
            self._reason = reason

    def _end_run(self, found: list[VectorNavMessage | CorruptBytes]) -> None:
        if self._run:
            found.append(CorruptBytes(self._run, self._reason))
            self._run = 0


def _binary(buffer: bytes, at: int, base: int) -> BinaryPacket | str | None:
    """Return the output that starts at `at`, the reason why none does, or None if it is cut."""
    have = len(buffer) - at
    head = header_bytes(buffer[at + 1]) if have > 1 else None
    if have > 1 and head is None:
        return _HEADER
    if head is None or have < 1 + head:
        return None

    layout = layout_of(buffer[at + 1 : at + 1 + head])
    if layout is None:
        return _HEADER
    size = 1 + head + layout.struct.size + _CRC_BYTES
    if have < size:
        return None

    # The CRC of a body with its own CRC behind it is 0.
    is_valid = crc_hqx(buffer[at + 1 : at + size], 0) == 0
    values = layout.struct.unpack_from(buffer, at + 1 + head)
    return BinaryPacket(layout, values, size, base + at + size) if is_valid else _CHECKSUM


def _text(buffer: bytes, at: int, base: int) -> TextMessage | str | None:
    """Return the text that starts at `at`, the reason why none does, or None if it is cut."""
    after = buffer.find(END, at, at + MAX_TEXT)
    if after >= 0:
        after += len(END)
        return decode_text(buffer[at:after], base + after) or _TEXT
    tail = buffer[at : at + MAX_TEXT]
    if len(tail) == MAX_TEXT or PLAUSIBLE.fullmatch(tail) is None:
        return _TEXT
    return None
