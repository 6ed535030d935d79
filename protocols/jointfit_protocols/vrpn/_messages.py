"""Messages of VRPN 07.xx, big-endian, which are the same over TCP and UDP.

     0        4         8              12       16     20         24     24+n
    | length | seconds | microseconds | sender | type | sequence | body | zeros up to 8 bytes |

`length` is 24 + n, without the padding. Negative types belong to the connection. The peer numbers
all other types, and describes each number by a name.

| type | body |
|---|---|
| -1 sender description, -2 type description | u32 n, n bytes of name with its NUL; id in `sender` |
| -3 UDP channel | host and NUL; UDP port in `sender` |
| -4 log description, -5 disconnect | |
| ``vrpn_Tracker Pos_Quat`` | i32 sensor, i32, 3 f64 position, 4 f64 quaternion x y z w |
| ``vrpn_Tracker Velocity``, ``Acceleration`` | the same, then f64 interval of the quaternion, s |
| ``vrpn_Base ping_message``, ``pong_message`` | empty |

Source: VRPN 07.38, vrpn_Connection.C and vrpn_Tracker.C.
"""

from __future__ import annotations

import re
import struct
from enum import IntEnum
from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes

DEFAULT_PORT = 3883
"""Default TCP and UDP port of servers."""
MAJOR = 7
"""Major version that both sides must share; a different minor version is compatible."""
MINOR = 38
"""Newest minor version whose messages are supported."""
MAX_MESSAGE = 64_000
"""Largest size of a message, bytes, which is the buffer size of the reference implementation."""
MAX_IDS = 2000
"""Largest number of senders, and of types, that a peer may describe, as in the reference
implementation."""
MAX_NAME = 255
"""Largest size of a name, bytes."""
LOWEST_PORT = 1024
"""Lowest port to which a server connects back."""

HEADER = struct.Struct(">IIIiiI")
POSE_LAYOUT = struct.Struct(">i4x7d")
MOTION_LAYOUT = struct.Struct(">i4x8d")
NAME_LENGTH = struct.Struct(">I")

POS_QUAT = "vrpn_Tracker Pos_Quat"
VELOCITY = "vrpn_Tracker Velocity"
ACCELERATION = "vrpn_Tracker Acceleration"
PING = "vrpn_Base ping_message"
PONG = "vrpn_Base pong_message"
TYPE_NAMES = (POS_QUAT, VELOCITY, ACCELERATION, PING, PONG)
"""Names of the types that have a separate message class."""

_ANNOUNCED = re.compile(rb"([A-Za-z0-9.]{1,255}) ([0-9]{1,5})\0?")


class SystemType(IntEnum):
    """Types of messages that belong to the connection itself."""

    SENDER = -1
    TYPE = -2
    UDP = -3
    LOG = -4
    DISCONNECT = -5


class Cookie(NamedTuple):
    """First 24 bytes that each side of a TCP connection sends."""

    major: int = MAJOR
    minor: int = 38
    log_mode: int = 0
    """Logging by the peer, 0 to 3. Bit 0: it writes incoming messages to a file. Bit 1: it writes
    outgoing messages."""


class SenderDescription(NamedTuple):
    """Name of a sender, such as one tracker."""

    id: int
    name: str


class TypeDescription(NamedTuple):
    """Name of a message type, with its number."""

    id: int
    name: str


class UdpChannel(NamedTuple):
    """Request to send messages that need no guaranteed delivery to this UDP port."""

    port: int
    host: str


class Disconnect(NamedTuple):
    """Message that ends the connection."""


class TrackerPose(NamedTuple):
    """Pose of one sensor of a tracker."""

    time_us: int
    """Clock of the sender when the message was created, µs since 1970."""
    sender: int
    sensor: int
    x: float
    y: float
    z: float
    """Position, in metres by convention."""
    qx: float
    qy: float
    qz: float
    qw: float


class TrackerMotion(NamedTuple):
    """Velocity or acceleration of one sensor of a tracker."""

    type: str
    """Name of the type: `VELOCITY` or `ACCELERATION`."""
    time_us: int
    sender: int
    sensor: int
    x: float
    y: float
    z: float
    qx: float
    qy: float
    qz: float
    qw: float
    """Rotation during `interval_s`; for an acceleration, the change of this rotation per second."""
    interval_s: float


class Ping(NamedTuple):
    """Request for a `Pong` from the same sender."""

    time_us: int
    sender: int


class Pong(NamedTuple):
    """Answer to a `Ping`."""

    time_us: int
    sender: int


class VrpnMessage(NamedTuple):
    """Message that has no separate class."""

    time_us: int
    sender: int
    type: int
    body: bytes


VrpnContent = (
    Cookie
    | SenderDescription
    | TypeDescription
    | UdpChannel
    | Disconnect
    | TrackerPose
    | TrackerMotion
    | Ping
    | Pong
    | VrpnMessage
)


class Announcement(NamedTuple):
    """Datagram with which a client of a classic connection requests the server to connect back."""

    host: str
    """Address of the client as the client knows it. Servers use the datagram's source address."""
    port: int
    """TCP port on which the client listens."""


def decode_announcement(datagram: bytes) -> Announcement | CorruptBytes:
    """Return the announcement in a datagram; never raise.

    In the same way as the reference implementation, the function rejects ports below 1024, and
    hosts with characters other than letters, digits and dots.
    """
    found = _ANNOUNCED.fullmatch(datagram)
    if found is None:
        return CorruptBytes(len(datagram), "no announcement of a client")
    port = int(found[2])
    if not LOWEST_PORT <= port <= 0xFFFF:  # noqa: PLR2004 - highest port
        return CorruptBytes(len(datagram), f"port outside {LOWEST_PORT}..65535")
    return Announcement(found[1].decode(), port)
