"""Encoder of VRPN messages, for the client side of a driver and for simulators."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_protocols.vrpn._messages import (
    HEADER,
    MAX_MESSAGE,
    MOTION_LAYOUT,
    NAME_LENGTH,
    PING,
    PONG,
    POS_QUAT,
    POSE_LAYOUT,
    Announcement,
    Cookie,
    Disconnect,
    Ping,
    Pong,
    SenderDescription,
    SystemType,
    TrackerMotion,
    TrackerPose,
    TypeDescription,
    UdpChannel,
    VrpnContent,
    VrpnMessage,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

_US = 1_000_000


def encode(
    message: VrpnContent,
    types: Mapping[str, int] | None = None,
    *,
    sequence: int = 0,
    time_us: int = 0,
) -> bytes:
    """Return the bytes of a message on the wire, including padding.

    Parameters
    ----------
    message : VrpnContent
        Message to encode.
    types : mapping of str to int, optional
        Number that this side has given to each message type, by name. Tracker messages, `Ping` and
        `Pong` need these numbers.
    sequence : int
        Sequence number of the message in this connection.
    time_us : int
        Time for the header of messages that contain no time, µs since 1970.

    Raises
    ------
    ValueError
        The message has more than 64 000 bytes.
    KeyError
        The type of the message is not in `types`.
    """
    if isinstance(message, Cookie):
        text = f"vrpn: ver. {message.major:02d}.{message.minor:02d}  {message.log_mode}"
        return text.encode().ljust(24, b"\0")

    sender, kind, body = _parts(message, types or {})
    length = HEADER.size + len(body)
    if length > MAX_MESSAGE:
        raise ValueError(f"{length} bytes: a VRPN message has at most {MAX_MESSAGE}")
    seconds, micros = divmod(getattr(message, "time_us", time_us), _US)
    header = HEADER.pack(length, seconds, micros, sender, kind, sequence & 0xFFFFFFFF)
    return header + body + bytes(-length % 8)


def encode_announcement(announcement: Announcement) -> bytes:
    """Return the datagram with which a client requests the server to connect back."""
    return f"{announcement.host} {announcement.port}\0".encode()


def _parts(  # noqa: PLR0911 - one case per type
    message: VrpnContent, types: Mapping[str, int]
) -> tuple[int, int, bytes]:
    """Return sender, type and body of a message."""
    match message:
        # The reference implementation repeats the sensor number instead of padding.
        case TrackerPose():
            body = POSE_LAYOUT.pack(*message[2:])
            return message.sender, types[POS_QUAT], body[:4] + body[:4] + body[8:]
        case TrackerMotion():
            body = MOTION_LAYOUT.pack(*message[3:])
            return message.sender, types[message.type], body[:4] + body[:4] + body[8:]
        case Ping():
            return message.sender, types[PING], b""
        case Pong():
            return message.sender, types[PONG], b""
        case SenderDescription():
            return message.id, SystemType.SENDER, _name(message.name)
        case TypeDescription():
            return message.id, SystemType.TYPE, _name(message.name)
        case UdpChannel():
            return message.port, SystemType.UDP, message.host.encode() + b"\0"
        case Disconnect():
            return 0, SystemType.DISCONNECT, b""
        case VrpnMessage():
            return message.sender, message.type, message.body
    raise TypeError("a cookie has no header")


def _name(name: str) -> bytes:
    data = name.encode() + b"\0"
    return NAME_LENGTH.pack(len(data)) + data
