"""NatNet messages on UDP: connection, description of the server, and echoes that compare clocks.

    | u16 id | u16 payload length | payload |      little-endian; length = size of the datagram - 4

`decode` accepts datagrams of both directions, because a capture contains both. In addition, a
simulator decodes the datagrams of a driver.

Source: NaturalPoint NatNet SDK 4.1, NatNetTypes.h; a capture of Motive 2.1.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.natnet._connect import Connect, Version4, decode_connect, encode_connect
from jointfit_protocols.natnet._cursor import fixed_text, put_fixed_text
from jointfit_protocols.natnet._frame import FrameOfData, Version
from jointfit_protocols.natnet._frame_decode import decode_frame
from jointfit_protocols.natnet._frame_encode import encode_frame
from jointfit_protocols.natnet._model import ModelDefinition, decode_model
from jointfit_protocols.natnet._model_encode import encode_model

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_DATAGRAM = 65_507
"""Largest payload of a UDP datagram over IPv4, bytes."""

HEADER = struct.Struct("<HH")
_STAMP = struct.Struct("<Q")
_ECHO = struct.Struct("<QQ")
_INFO = struct.Struct("<256s4B4B")
_INFO_TAIL = struct.Struct("<QHB4B")


class NatNetMessageId(IntEnum):
    """Message id, which is the first field of the header."""

    CONNECT = 0
    SERVERINFO = 1
    REQUEST = 2
    RESPONSE = 3
    REQUEST_MODELDEF = 4
    MODELDEF = 5
    REQUEST_FRAMEOFDATA = 6
    FRAMEOFDATA = 7
    MESSAGESTRING = 8
    DISCONNECT = 9
    KEEPALIVE = 10
    DISCONNECTBYTIMEOUT = 11
    ECHOREQUEST = 12
    ECHORESPONSE = 13
    DISCOVERY = 14
    UNRECOGNIZED_REQUEST = 100


class ServerInfo(NamedTuple):
    """The answer to CONNECT and DISCOVERY."""

    application: str
    application_version: Version4
    natnet_version: Version4
    """NatNet version of the server. Its first two numbers are the bitstream in use, unless the
    bitstream was changed."""
    clock_hz: int | None
    """Number of ticks per second of the stamps in frames; None for a 2.x server."""
    data_port: int = 1511
    multicast: bool = False
    group: str = "239.255.42.99"

    @property
    def bitstream(self) -> Version:
        """Bitstream version that the server uses at first."""
        return self.natnet_version[:2]


class Discovery(NamedTuple):
    """CONNECT as a broadcast, which every server answers."""

    connect: Connect


class CommandRequest(NamedTuple):
    """A text command, such as ``FrameRate`` or ``Bitstream,4.1``."""

    command: str


class CommandResponse(NamedTuple):
    """The answer to a `CommandRequest`: int32, float32 or text, depending on the command."""

    data: bytes

    @property
    def text(self) -> str:
        """Answer interpreted as text."""
        return fixed_text(self.data)


class MessageString(NamedTuple):
    """Text that the server sends for the operator."""

    text: str


class EchoRequest(NamedTuple):
    """Request with a stamp that the client chooses."""

    stamp: int


class EchoResponse(NamedTuple):
    """Answer with the client's stamp, and the server's ticks at the arrival of the request."""

    stamp: int
    ticks: int


class Bare(NamedTuple):
    """A message that consists only of its id. Bytes after the header have no meaning."""

    id: NatNetMessageId


Message = (
    Connect
    | Discovery
    | ServerInfo
    | CommandRequest
    | CommandResponse
    | ModelDefinition
    | FrameOfData
    | MessageString
    | EchoRequest
    | EchoResponse
    | Bare
)


def decode(datagram: bytes, version: Version) -> Message | CorruptBytes:
    """Return the message in `datagram`; frames and models are in bitstream `version`.

    The function never raises. A datagram that is not one complete message becomes a single
    `CorruptBytes`.
    """
    if len(datagram) < HEADER.size:
        return CorruptBytes(len(datagram), "shorter than a header")

    number, size = HEADER.unpack_from(datagram)
    if size != len(datagram) - HEADER.size:
        return CorruptBytes(
            len(datagram), "the length in the header is not the length of the datagram"
        )

    by_version = _VERSIONED.get(number)
    if by_version is not None:
        return by_version(datagram, version)

    read = _READERS.get(number)
    if read is None:
        return CorruptBytes(len(datagram), f"no message has id {number}")

    found = read(datagram[HEADER.size :])
    if found is None:
        return CorruptBytes(
            len(datagram), f"{NatNetMessageId(number).name}: no form has {len(datagram)} bytes"
        )
    return found


def is_versioned(datagram: bytes) -> bool:
    """Return whether the layout of the message in `datagram` depends on the bitstream."""
    if len(datagram) < HEADER.size:
        return False
    number, size = HEADER.unpack_from(datagram)
    return number in _VERSIONED and size == len(datagram) - HEADER.size


def encode(message: Message, version: Version = (3, 0)) -> bytes:
    """Return `message` as one datagram; frames and models are in bitstream `version`.

    Raises
    ------
    ValueError
        The message does not exist in this bitstream, or is too long for one datagram.
    """
    number, payload = _payload(message, version)
    if len(payload) + HEADER.size > MAX_DATAGRAM:
        raise ValueError(f"{len(payload)} bytes exceed one datagram")
    return HEADER.pack(number, len(payload)) + payload


# --- reading ----------------------------------------------------------------------------------


def _read_info(data: bytes) -> ServerInfo | None:
    if len(data) not in (_INFO.size, _INFO.size + _INFO_TAIL.size):
        return None
    name, a, b, c, d, e, f, g, h = _INFO.unpack_from(data)
    info = ServerInfo(fixed_text(name), (a, b, c, d), (e, f, g, h), None)
    if len(data) == _INFO.size:
        return info

    hz, port, multicast, *group = _INFO_TAIL.unpack_from(data, _INFO.size)
    address = ".".join(map(str, group))
    return info._replace(clock_hz=hz, data_port=port, multicast=bool(multicast), group=address)


def _read_discovery(data: bytes) -> Discovery | None:
    connect = decode_connect(data)
    return None if connect is None else Discovery(connect)


def _fixed_reader(
    kind: type[EchoRequest | EchoResponse], layout: struct.Struct
) -> Callable[[bytes], Message | None]:
    """Return a reader for a message that consists of a single record."""
    return lambda data: kind(*layout.unpack(data)) if len(data) == layout.size else None


def _bare(number: NatNetMessageId) -> Callable[[bytes], Message | None]:
    return lambda _: Bare(number)


_VERSIONED: dict[int, Callable[[bytes, Version], FrameOfData | ModelDefinition | CorruptBytes]] = {
    NatNetMessageId.FRAMEOFDATA: decode_frame,
    NatNetMessageId.MODELDEF: decode_model,
}

_READERS: dict[int, Callable[[bytes], Message | None]] = {
    NatNetMessageId.CONNECT: decode_connect,
    NatNetMessageId.DISCOVERY: _read_discovery,
    NatNetMessageId.SERVERINFO: _read_info,
    NatNetMessageId.REQUEST: lambda data: CommandRequest(fixed_text(data)),
    NatNetMessageId.RESPONSE: CommandResponse,
    NatNetMessageId.MESSAGESTRING: lambda data: MessageString(fixed_text(data)),
    NatNetMessageId.ECHOREQUEST: _fixed_reader(EchoRequest, _STAMP),
    NatNetMessageId.ECHORESPONSE: _fixed_reader(EchoResponse, _ECHO),
    NatNetMessageId.REQUEST_MODELDEF: _bare(NatNetMessageId.REQUEST_MODELDEF),
    NatNetMessageId.REQUEST_FRAMEOFDATA: _bare(NatNetMessageId.REQUEST_FRAMEOFDATA),
    NatNetMessageId.DISCONNECT: _bare(NatNetMessageId.DISCONNECT),
    NatNetMessageId.KEEPALIVE: _bare(NatNetMessageId.KEEPALIVE),
    NatNetMessageId.DISCONNECTBYTIMEOUT: _bare(NatNetMessageId.DISCONNECTBYTIMEOUT),
    NatNetMessageId.UNRECOGNIZED_REQUEST: _bare(NatNetMessageId.UNRECOGNIZED_REQUEST),
}


# --- writing ----------------------------------------------------------------------------------


def _payload(message: Message, version: Version) -> tuple[NatNetMessageId, bytes]:  # noqa: C901, PLR0911 - one case per message
    match message:
        case FrameOfData():
            return NatNetMessageId.FRAMEOFDATA, encode_frame(message, version)
        case ModelDefinition():
            return NatNetMessageId.MODELDEF, encode_model(message, version)
        case ServerInfo():
            return NatNetMessageId.SERVERINFO, _put_info(message)
        case Connect():
            return NatNetMessageId.CONNECT, encode_connect(message)
        case Discovery():
            return NatNetMessageId.DISCOVERY, encode_connect(message.connect)
        case CommandRequest():
            return NatNetMessageId.REQUEST, message.command.encode() + b"\0"
        case CommandResponse():
            return NatNetMessageId.RESPONSE, message.data
        case MessageString():
            return NatNetMessageId.MESSAGESTRING, message.text.encode() + b"\0"
        case EchoRequest():
            return NatNetMessageId.ECHOREQUEST, _STAMP.pack(message.stamp)
        case EchoResponse():
            return NatNetMessageId.ECHORESPONSE, _ECHO.pack(*message)
        case Bare():
            return message.id, b""


def _put_info(info: ServerInfo) -> bytes:
    name = put_fixed_text(info.application, 256)
    head = _INFO.pack(name, *info.application_version, *info.natnet_version)
    if info.clock_hz is None:
        return head
    group = (int(part) for part in info.group.split("."))
    return head + _INFO_TAIL.pack(info.clock_hz, info.data_port, info.multicast, *group)
