"""MIP packets of MicroStrain devices on a serial line.

     0    1    2         3    4 ..            4+n  5+n
    | 75 | 65 | desc.set | n | fields ...    | S1 | S2 |
    field: | length, with itself and the descriptor | descriptor | data |

S1 is the sum of all bytes before the checksum, S2 the sum of all values of S1, both modulo 256.
The fields end exactly at n. Numbers are big-endian. Descriptor sets below 0x80 are commands and
their replies, the others are data.

Source: the packet documentation of the vendor's mip_sdk (MIT); checked on 8384 recorded packets.

Invariant: bytes in, packets out; no port, no clock.
"""

from __future__ import annotations

from itertools import accumulate
from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.corrupt import CorruptBytes

if TYPE_CHECKING:
    from collections.abc import Iterable

SYNC = b"ue"
MAX_PAYLOAD = 255
MAX_PACKET = MAX_PAYLOAD + 6
_HEAD, _CHECKSUM_BYTES, _FIELD_HEAD = 4, 2, 2
_RUN = MAX_PACKET
"""Bytes of noise after which a run is reported, so that the sum of corrupt bytes is up to date."""

_NO_START = "no packet starts here"
_CHECKSUM = "checksum"
_FIELDS = "fields do not fill the packet"
_CUT_OFF = "cut off"

MipField = tuple[int, bytes]
"""Descriptor and data of one field."""


class MipPacket(NamedTuple):
    """One packet with a valid checksum."""

    descriptor_set: int
    fields: tuple[MipField, ...]
    size: int
    """Bytes on the wire."""
    end: int = 0
    """Bytes fed to the decoder up to and including the checksum, for back-dating."""


def encode(descriptor_set: int, fields: Iterable[MipField]) -> bytes:
    """Return the packet on the wire.

    Raises
    ------
    ValueError
        The fields are longer than 255 bytes.
    """
    payload = b"".join(
        bytes((len(data) + _FIELD_HEAD, descriptor)) + data for descriptor, data in fields
    )
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"{len(payload)} bytes of fields: a MIP packet holds {MAX_PAYLOAD}")
    body = SYNC + bytes((descriptor_set, len(payload))) + payload
    return body + _checksum(body)


def _checksum(body: bytes) -> bytes:
    return bytes((sum(body) & 0xFF, sum(accumulate(body)) & 0xFF))


def split_fields(payload: bytes) -> tuple[MipField, ...] | None:
    """Return the fields of a packet; None if they do not end exactly at its end."""
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


class MipCodec:
    """Decoder of pieces of any size to packets; the result does not depend on the pieces.

    A run of bytes without a packet becomes one `CorruptBytes`: before the packet that ends it, at
    `flush`, or every 261 bytes.
    """

    def __init__(self) -> None:
        self._pending = b""  # under one packet between calls: MAX_PACKET bounds it
        self.fed = 0
        """Bytes fed so far."""
        self._run = 0
        self._reason = ""
        self.packets = 0
        """Packets so far."""
        self.discarded = 0
        """Bytes without a packet so far."""
        self.checksum_failures = 0
        """Complete candidates with a wrong checksum so far."""

    @property
    def pending(self) -> int:
        """Bytes of an incomplete packet."""
        return len(self._pending)

    def feed(self, data: bytes) -> list[MipPacket | CorruptBytes]:
        """Return the packets that `data` completed, in wire order; never raises."""
        return self._scan(data, final=False)

    def flush(self) -> list[MipPacket | CorruptBytes]:
        """End the input, or a silence: return packets hidden in the pending bytes."""
        found = self._scan(b"", final=True)
        self._end_run(found)
        return found

    def _scan(self, data: bytes, *, final: bool) -> list[MipPacket | CorruptBytes]:
        buffer = self._pending + data if self._pending else bytes(data)
        base = self.fed - len(self._pending)
        self.fed += len(data)
        found: list[MipPacket | CorruptBytes] = []

        at, end = 0, len(buffer)
        while at < end:
            start = buffer.find(SYNC, at)
            if start < 0:  # the last byte may be the first half of a start
                start = end - (buffer[-1] == SYNC[0])
            if start > at:
                self._skip(start - at, _NO_START, found)
                at = start

            size = buffer[at + 3] + _HEAD + _CHECKSUM_BYTES if end - at >= _HEAD else _HEAD
            if at + size > end or end - at < _HEAD:
                if not final or at == end:
                    break
                self._skip(1, _CUT_OFF, found)
                at += 1
                continue

            body = buffer[at : at + size - _CHECKSUM_BYTES]
            fields = None
            if buffer[at + size - _CHECKSUM_BYTES : at + size] != _checksum(body):
                reason = _CHECKSUM
            else:
                reason, fields = _FIELDS, split_fields(body[_HEAD:])

            if fields is None:  # a packet may start inside a corrupt one: skip one byte only
                self._skip(1, reason, found)
                at += 1
                continue
            if self._run:
                self._end_run(found)
            found.append(MipPacket(body[2], fields, size, base + at + size))
            self.packets += 1
            at += size
        self._pending = buffer[at:]
        return found

    def _skip(self, count: int, reason: str, found: list[MipPacket | CorruptBytes]) -> None:
        """Count bytes without a packet; the first fault names the run."""
        self.discarded += count
        self.checksum_failures += reason == _CHECKSUM
        if self._run == 0 or self._reason == _NO_START:
            self._reason = reason
        self._run += count
        while self._run >= _RUN:
            found.append(CorruptBytes(_RUN, self._reason))
            self._run -= _RUN
            self._reason = reason

    def _end_run(self, found: list[MipPacket | CorruptBytes]) -> None:
        if self._run:
            found.append(CorruptBytes(self._run, self._reason))
            self._run = 0
