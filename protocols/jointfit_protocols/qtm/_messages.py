"""Packets of the QTM real-time protocol: ``u32 size, u32 type, data``.

The size includes the size and the type. TCP and UDP use the same packets, but UDP transports only
frames and the discovery of servers.

Invariant: `decode` never raises, and never reads more than the packet, whatever count or size the
packet states.
"""

from __future__ import annotations

from enum import IntEnum
from struct import Struct
from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.packet_stream import PacketStream
from jointfit_protocols.qtm._components import (
    COMPONENT_HEAD,
    Component,
    decode_component,
    encode_component,
)

HEADER = Struct("<II")
"""Layout of the header of a packet: size and type."""
LARGEST_PACKET = 16 << 20
"""Largest accepted packet, bytes. A camera frame with thousands of markers has 100 kB."""
_LARGEST_TYPE = 0xFF
"""Largest plausible type of a packet. Known types are below 9."""
_LARGEST_TEXT = 4 << 20
"""Largest accepted XML document or text, bytes."""
_FRAME_HEAD = Struct("<qII")
"""Layout of the head of a frame: timestamp, µs; frame number; number of components."""
_DISCOVER_PORT = Struct(">H")


class PacketType(IntEnum):
    """Types of packets."""

    ERROR = 0
    COMMAND = 1
    XML = 2
    DATA = 3
    NO_MORE_DATA = 4
    C3D_FILE = 5
    EVENT = 6
    DISCOVER = 7
    QTM_FILE = 8


class QtmEvent(IntEnum):
    """Events that a server reports."""

    CONNECTED = 1
    CONNECTION_CLOSED = 2
    CAPTURE_STARTED = 3
    CAPTURE_STOPPED = 4
    FETCHING_FINISHED = 5
    CALIBRATION_STARTED = 6
    CALIBRATION_STOPPED = 7
    RT_FROM_FILE_STARTED = 8
    RT_FROM_FILE_STOPPED = 9
    WAITING_FOR_TRIGGER = 10
    CAMERA_SETTINGS_CHANGED = 11
    SHUTTING_DOWN = 12
    CAPTURE_SAVED = 13
    REPROCESSING_STARTED = 14
    REPROCESSING_STOPPED = 15
    TRIGGER = 16


class ErrorReply(NamedTuple):
    """An error text from the server."""

    text: str


class Command(NamedTuple):
    """A command of a client, or the server's answer."""

    text: str


class SettingsReply(NamedTuple):
    """Settings of the server as an XML document."""

    xml: str


class DataFrame(NamedTuple):
    """One camera frame. Over UDP, it may be a part of a camera frame."""

    timestamp_us: int
    """Time since the beginning of the measurement, µs."""
    number: int
    components: tuple[Component, ...]


class NoMoreData(NamedTuple):
    """Message that the measurement has ended or has not begun."""


class Event(NamedTuple):
    """A state change of the server: a `QtmEvent` or a number of a newer version."""

    number: int


class Discover(NamedTuple):
    """UDP broadcast of a client, which requests answers to one of the client's ports."""

    port: int


class SkippedPacket(NamedTuple):
    """A packet that is not read: a file, a newer type, or a discovery of unexpected length."""

    type: int
    data: bytes


Message = (
    ErrorReply | Command | SettingsReply | DataFrame | NoMoreData | Event | Discover | SkippedPacket
)


_TEXT_KINDS: dict[int, type[ErrorReply | Command | SettingsReply]] = {
    PacketType.ERROR: ErrorReply,
    PacketType.COMMAND: Command,
    PacketType.XML: SettingsReply,
}


class ServerAnnouncement(NamedTuple):
    """Answer to `Discover`: ``HOST, QTM 2.5 (build 568), 5 cameras`` and the base port."""

    text: str
    base_port: int


def decode(packet: bytes) -> Message | CorruptBytes:
    """Return the message in one complete packet; never raise.

    Parameters
    ----------
    packet : bytes
        Packet that `QtmStream` split from a TCP connection, or one datagram.
    """
    if len(packet) < HEADER.size:
        return CorruptBytes(len(packet), "shorter than a packet header")
    size, kind = HEADER.unpack_from(packet)
    if size != len(packet):
        return CorruptBytes(len(packet), f"packet of {len(packet)} bytes states {size} bytes")

    if kind == PacketType.DATA:
        return _decode_frame(packet)
    return _decode_other(packet, kind)


def _decode_other(packet: bytes, kind: int) -> Message | CorruptBytes:
    data = packet[HEADER.size :]
    text_kind = _TEXT_KINDS.get(kind)
    if text_kind is not None:
        if len(data) > _LARGEST_TEXT:
            return CorruptBytes(len(packet), f"text of {len(data)} bytes")
        return text_kind(data.split(b"\0", 1)[0].decode("utf-8", "replace"))
    if kind == PacketType.EVENT:
        if len(data) != 1:
            return CorruptBytes(len(packet), f"event of {len(data)} bytes, expected 1")
        return Event(data[0])
    if kind == PacketType.DISCOVER and len(data) == _DISCOVER_PORT.size:
        return Discover(_DISCOVER_PORT.unpack(data)[0])
    return NoMoreData() if kind == PacketType.NO_MORE_DATA else SkippedPacket(kind, data)


def _decode_frame(packet: bytes) -> DataFrame | CorruptBytes:
    size = len(packet)
    if size < HEADER.size + _FRAME_HEAD.size:
        return CorruptBytes(size, "data packet without a frame header")
    timestamp_us, number, count = _FRAME_HEAD.unpack_from(packet, HEADER.size)
    components = _decode_components(packet, HEADER.size + _FRAME_HEAD.size, count)
    if isinstance(components, str):
        return CorruptBytes(size, components)
    return DataFrame(timestamp_us, number, components)


def _decode_components(packet: bytes, at: int, count: int) -> tuple[Component, ...] | str:
    """Return `count` components that fill a packet from `at` on, or the reason why they do not."""
    size = len(packet)
    if count * COMPONENT_HEAD.size > size - at:
        return f"{count} components in {size - at} bytes"

    view = memoryview(packet)
    components = []
    for _ in range(count):
        if size - at < COMPONENT_HEAD.size:
            return "data packet ends before its last component"
        length, kind = COMPONENT_HEAD.unpack_from(packet, at)
        if not COMPONENT_HEAD.size <= length <= size - at:
            return f"component states {length} bytes, expected {COMPONENT_HEAD.size} to {size - at}"
        component = decode_component(kind, view[at + COMPONENT_HEAD.size : at + length])
        if isinstance(component, str):
            return component
        components.append(component)
        at += length
    return tuple(components) if at == size else f"{size - at} bytes after the last component"


def encode(message: Message) -> bytes:
    """Return the packet of a message. Texts end with a NUL."""
    kind, data = 0, b""
    match message:
        case ErrorReply(text):
            kind, data = PacketType.ERROR, text.encode() + b"\0"
        case Command(text):
            kind, data = PacketType.COMMAND, text.encode() + b"\0"
        case SettingsReply(text):
            kind, data = PacketType.XML, text.encode() + b"\0"
        case DataFrame(timestamp_us, number, components):
            head = _FRAME_HEAD.pack(timestamp_us, number, len(components))
            kind, data = PacketType.DATA, head + b"".join(map(encode_component, components))
        case NoMoreData():
            kind, data = PacketType.NO_MORE_DATA, b""
        case Event(number):
            kind, data = PacketType.EVENT, bytes((number,))
        case Discover(port):
            kind, data = PacketType.DISCOVER, _DISCOVER_PORT.pack(port)
        case SkippedPacket():
            kind, data = message
    return HEADER.pack(HEADER.size + len(data), kind) + data


class QtmStream(PacketStream):
    """Splits the bytes of a connection into packets."""

    def __init__(self) -> None:
        super().__init__(HEADER.size, _packet_size)


def _packet_size(buffer: bytearray, at: int) -> int | None:
    size, kind = HEADER.unpack_from(buffer, at)
    return size if HEADER.size <= size <= LARGEST_PACKET and kind <= _LARGEST_TYPE else None


def decode_announcement(datagram: bytes) -> ServerAnnouncement | CorruptBytes:
    """Return the answer to a discovery. Its port follows the text and is big-endian."""
    shortest = HEADER.size + 1 + _DISCOVER_PORT.size
    if len(datagram) < shortest:
        return CorruptBytes(len(datagram), f"{len(datagram)} bytes, expected {shortest} or more")
    size, kind = HEADER.unpack_from(datagram)
    if size != len(datagram) or kind != PacketType.COMMAND:
        return CorruptBytes(
            len(datagram), f"type {kind} of {size} bytes is not an answer to discovery"
        )
    text = datagram[HEADER.size : -_DISCOVER_PORT.size].split(b"\0", 1)[0]
    (port,) = _DISCOVER_PORT.unpack_from(datagram, len(datagram) - _DISCOVER_PORT.size)
    return ServerAnnouncement(text.decode("utf-8", "replace"), port)


def encode_announcement(announcement: ServerAnnouncement) -> bytes:
    """Return the datagram of an answer to a discovery."""
    data = announcement.text.encode() + b"\0" + _DISCOVER_PORT.pack(announcement.base_port)
    return HEADER.pack(HEADER.size + len(data), PacketType.COMMAND) + data
