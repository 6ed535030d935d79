"""MIP packets of MicroStrain devices on a serial line.

     0    1    2         3    4 ..            4+n  5+n
    | 75 | 65 | desc.set | n | fields ...    | S1 | S2 |
    field: | length, including itself and the descriptor | descriptor | data |

S1 is the sum of all bytes before the checksum, and S2 is the sum of all values of S1, both modulo
256. The fields fill the n bytes exactly. Numbers are big-endian. Descriptor sets below 0x80 are
commands and their replies. All other sets are data.

Source: the packet documentation of the vendor's mip_sdk (MIT); checked on 8384 recorded packets.

Invariant: the codec converts bytes to packets. It uses no port and no clock.
"""

from __future__ import annotations

import re
from itertools import accumulate
from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.corrupt import CHECKSUM, CorruptBytes
from jointfit_protocols.resynchronizing_codec import ResynchronizingCodec

if TYPE_CHECKING:
    from collections.abc import Iterable

SYNC = b"ue"
MAX_PAYLOAD = 255
MAX_PACKET = MAX_PAYLOAD + 6
_HEAD, _CHECKSUM_BYTES, _FIELD_HEAD = 4, 2, 2
_START = re.compile(SYNC + b"|" + SYNC[:1] + rb"\Z")
_NO_START = CorruptBytes(1, "no packet starts here")
_CHECKSUM = CorruptBytes(1, CHECKSUM)
_FIELDS = CorruptBytes(1, "fields do not fill the packet")

MipField = tuple[int, bytes]
"""Descriptor and data of one field."""


class MipPacket(NamedTuple):
    """One packet whose checksum is correct."""

    descriptor_set: int
    fields: tuple[MipField, ...]
    size: int
    """Length of the packet on the wire, bytes."""
    end: int = 0
    """Number of bytes fed to the codec until the end of the checksum. Drivers compute the
    arrival time of the first byte from this number."""


def encode(descriptor_set: int, fields: Iterable[MipField]) -> bytes:
    """Return the bytes of a packet on the wire.

    Raises
    ------
    ValueError
        The fields have more than 255 bytes.
    """
    payload = b"".join(
        bytes((len(data) + _FIELD_HEAD, descriptor)) + data for descriptor, data in fields
    )
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"{len(payload)} bytes of fields: at most {MAX_PAYLOAD} fit a MIP packet")
    body = SYNC + bytes((descriptor_set, len(payload))) + payload
    return body + _checksum(body)


def _checksum(body: bytes) -> bytes:
    return bytes((sum(body) & 0xFF, sum(accumulate(body)) & 0xFF))


def split_fields(payload: bytes) -> tuple[MipField, ...] | None:
    """Return the fields of a packet; None if they do not fill the packet exactly."""
    fields: list[MipField] = []
    at, end = 0, len(payload)
    while at < end:
        size = payload[at]
        after = at + size
        if size < _FIELD_HEAD or after > end:
            return None
        fields.append((payload[at + 1], payload[at + _FIELD_HEAD : after]))
        at = after
    return tuple(fields)


def _read_packet(buffer: bytes, at: int, base: int) -> MipPacket | CorruptBytes | None:
    """Return the packet at `at`, the reason why there is none, or None if it is incomplete."""
    end = len(buffer)
    if not buffer.startswith(SYNC, at):  # the last byte may be the first start byte
        return None if at == end - 1 and buffer[at] == SYNC[0] else _NO_START

    if end - at < _HEAD:
        return None
    tail = at + _HEAD + buffer[at + 3]
    after = tail + _CHECKSUM_BYTES
    if after > end:
        return None

    body = buffer[at:tail]
    if buffer[tail:after] != _checksum(body):
        return _CHECKSUM
    fields = split_fields(body[_HEAD:])
    return _FIELDS if fields is None else MipPacket(body[2], fields, after - at, base + after)


class MipCodec(ResynchronizingCodec[MipPacket]):
    """Codec that converts a byte stream to packets; the stream may be split at any position.

    Runs of corrupt bytes are reported after at most 261 bytes.
    """

    def __init__(self) -> None:
        super().__init__(_read_packet, _START, MAX_PACKET, _NO_START.reason)
