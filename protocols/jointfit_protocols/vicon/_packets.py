"""Packets of the Vicon DataStream: ``u32 0x1A2B0001, u32 length``, followed by objects.

Invariant: `decode` never raises.
"""

from __future__ import annotations

from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.packet_stream import PacketStream
from jointfit_protocols.vicon._messages import HEADER, LARGEST_PACKET, PACKET, Object
from jointfit_protocols.vicon._objects import decode_object, encode_object


class Packet(NamedTuple):
    """One packet of the stream."""

    objects: tuple[Object, ...]


def decode(packet: bytes) -> Packet | CorruptBytes:
    """Return the content of one complete packet; never raise."""
    size = len(packet)
    if size < HEADER.size:
        return CorruptBytes(size, "shorter than a packet header")
    kind, length = HEADER.unpack_from(packet)
    if kind != PACKET:
        return CorruptBytes(size, f"block {kind:#x} is no packet")
    if length != size - HEADER.size:
        return CorruptBytes(size, f"packet of {size} bytes states {length + HEADER.size} bytes")

    objects = _decode_objects(packet)
    return CorruptBytes(size, objects) if isinstance(objects, str) else Packet(objects)


def _decode_objects(packet: bytes) -> tuple[Object, ...] | str:
    """Return the objects of a packet, or the reason why they are corrupt."""
    view, size, at = memoryview(packet), len(packet), HEADER.size
    objects = []
    while at < size:
        if size - at < HEADER.size:
            return f"{size - at} bytes after the last object"
        kind, length = HEADER.unpack_from(packet, at)
        at += HEADER.size
        if length > size - at:
            return f"object {kind} states {length} bytes, but {size - at} follow"
        item = decode_object(kind, view[at : at + length])
        if isinstance(item, str):
            return item
        objects.append(item)
        at += length
    return tuple(objects)


def encode(*objects: Object) -> bytes:
    """Return a packet that contains these objects."""
    bodies = map(encode_object, objects)
    data = b"".join(HEADER.pack(kind, len(body)) + body for kind, body in bodies)
    return HEADER.pack(PACKET, len(data)) + data


class ViconStream(PacketStream):
    """Splits the bytes of a connection into packets."""

    def __init__(self) -> None:
        super().__init__(HEADER.size, _packet_size)


def _packet_size(buffer: bytearray, at: int) -> int | None:
    kind, length = HEADER.unpack_from(buffer, at)
    is_packet = kind == PACKET and length <= LARGEST_PACKET
    return int(length) + HEADER.size if is_packet else None
