"""Messages of VectorNav devices on a serial line: a mixture of binary outputs and ASCII messages.

    | FA | header | payload | CRC, high byte first |      header and payload: `_layout`
    | $ | content | * | checksum | CR LF |                `_text`

The CRC has the polynomial 0x1021 and the initial value 0. It includes header and payload. The
header determines the length.

Source: VN-100 user manual (UM001), section 5.

Invariant: the codec converts bytes to messages. It uses no port and no clock.
"""

from __future__ import annotations

import re
import struct
from binascii import crc_hqx
from typing import TYPE_CHECKING, Any, NamedTuple

from jointfit_protocols.corrupt import CHECKSUM, NO_START, CorruptBytes
from jointfit_protocols.resynchronizing_codec import ResynchronizingCodec
from jointfit_protocols.vectornav._layout import (
    MAX_HEADER,
    MAX_PAYLOAD,
    BinaryLayout,
    header_bytes,
    layout_of,
)
from jointfit_protocols.vectornav._text import (
    END,
    MAX_TEXT,
    PLAUSIBLE,
    START,
    TextMessage,
    decode_text,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

SYNC = 0xFA
_CRC_BYTES = 2
MAX_MESSAGE = 1 + MAX_HEADER + MAX_PAYLOAD + _CRC_BYTES
"""Size of the largest message, bytes."""
_START = re.compile(rb"[\xfa$]")

_NO_START = CorruptBytes(1, NO_START)
_CHECKSUM = CorruptBytes(1, CHECKSUM)
UNKNOWN_HEADER = "header unknown to this version"
"""Reason for the bytes of a binary output whose layout is not known."""
_HEADER = CorruptBytes(1, UNKNOWN_HEADER)
_TEXT = CorruptBytes(1, "malformed text")


class BinaryPacket(NamedTuple):
    """One binary output whose CRC is correct."""

    layout: BinaryLayout
    values: tuple[Any, ...]
    """Values of all fields. `BinaryLayout.places` contains their indices."""
    size: int
    """Length of the message on the wire, bytes."""
    end: int = 0
    """Number of bytes fed to the codec until the end of the CRC. Drivers compute the
    arrival time of the first byte from this number."""


VectorNavMessage = BinaryPacket | TextMessage


def encode_binary(values: Mapping[int, tuple[Any, ...]]) -> bytes:
    """Return the bytes of a binary output with these fields on the wire.

    Raises
    ------
    KeyError
        The size of a field is unknown.
    struct.error
        The values do not fit the field.
    """
    layout = BinaryLayout(values)
    flat = [value for field in layout.fields for value in values[field]]
    body = layout.header + layout.struct.pack(*flat)
    return bytes((SYNC,)) + body + struct.pack(">H", crc_hqx(body, 0))


def _read_message(buffer: bytes, at: int, base: int) -> VectorNavMessage | CorruptBytes | None:
    """Return the message at `at`, the reason why there is none, or None if it is incomplete."""
    if buffer[at] != SYNC:
        return _text(buffer, at, base) if buffer[at] == START[0] else _NO_START

    head = header_bytes(buffer, at + 1)
    if head is None:
        return None
    layout = layout_of(buffer[at + 1 : at + 1 + head]) if head else None
    if layout is None:
        return _HEADER
    size = 1 + head + layout.struct.size + _CRC_BYTES
    if len(buffer) - at < size:
        return None

    # The CRC of a body followed by its own CRC is 0.
    if crc_hqx(buffer[at + 1 : at + size], 0) != 0:
        return _CHECKSUM
    values = layout.struct.unpack_from(buffer, at + 1 + head)
    return BinaryPacket(layout, values, size, base + at + size)


def _text(buffer: bytes, at: int, base: int) -> TextMessage | CorruptBytes | None:
    """Return the text at `at`, the reason why there is none, or None if it is incomplete."""
    after = buffer.find(END, at, at + MAX_TEXT)
    if after >= 0:
        after += len(END)
        return decode_text(buffer[at:after], base + after) or _TEXT
    tail = buffer[at : at + MAX_TEXT]
    if len(tail) == MAX_TEXT or PLAUSIBLE.fullmatch(tail) is None:
        return _TEXT
    return None


class VectorNavCodec(ResynchronizingCodec[VectorNavMessage]):
    """Codec that converts a byte stream to messages; the stream may be split at any position.

    Runs of corrupt bytes are reported after at most `MAX_MESSAGE` bytes.
    """

    def __init__(self) -> None:
        super().__init__(_read_message, _START, MAX_MESSAGE)
