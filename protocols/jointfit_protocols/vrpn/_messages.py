"""Messages of VRPN 07.xx, big-endian, equal over TCP and UDP.

     0        4         8              12       16     20         24     24+n
    | length | seconds | microseconds | sender | type | sequence | body | zeros up to 8 bytes |

`length` is 24 + n, without padding. Negative types belong to the connection; all others are
numbered by the peer, which describes each number by a name.

| type | body |
|---|---|
| -1 sender description, -2 type description | u32 n, n bytes of name with its NUL; id in `sender` |
| -3 UDP channel | host and NUL; UDP port in `sender` |
| -4 log description, -5 disconnect | |
| ``vrpn_Tracker Pos_Quat`` | i32 sensor, i32, 3 f64 position, 4 f64 quaternion x y z w |
| ``vrpn_Tracker Velocity``, ``Acceleration`` | the same, f64 interval of the quaternion, s |
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
"""TCP and UDP port of servers."""
MAJOR = 7
MINOR = 38
"""Newest minor version whose messages are known."""
"""Version that both sides must share; a different minor version is compatible."""
MAX_MESSAGE = 64_000
"""Maximum size of a message in bytes, the buffer of the reference implementation."""
MAX_IDS = 2000
"""Senders, and types, that a peer may describe: the limit of the reference implementation."""
MAX_NAME = 255
"""Maximum size of a name in bytes."""
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
"""Names of the types that have a message class of their own."""

_ANNOUNCED = re.compile(rb"([A-Za-z0-9.]{1,255}) ([0-9]{1,5})\0?")


class SystemType(IntEnum):
    """Types of the connection itself."""

    SENDER = -1
    TYPE = -2
    UDP = -3
    LOG = -4
    DISCONNECT = -5


class Cookie(NamedTuple):
    """First 24 bytes of each side of a TCP connection."""

    major: int = MAJOR
    minor: int = 38
    log_mode: int = 0
    """Logging by the peer, 0 to 3: bit 0, it writes incoming messages to a file; bit 1, outgoing
    ones."""


class SenderDescription(NamedTuple):
    """Name of a sender, such as one tracker."""

    id: int
    name: str


class TypeDescription(NamedTuple):
    """Name of a message type."""

    id: int
    name: str


class UdpChannel(NamedTuple):
    """Request to send messages without delivery guarantee to this UDP port."""

    port: int
    host: str


class Disconnect(NamedTuple):
    """End of the connection."""


class TrackerPose(NamedTuple):
    """Pose of one sensor of a tracker."""

    time_us: int
    """Wall clock of the sender when the message was made, µs since 1970."""
    sender: int
    sensor: int
    x: float
    y: float
    z: float
    """Position, m by convention."""
    qx: float
    qy: float
    qz: float
    qw: float


class TrackerMotion(NamedTuple):
    """Velocity or acceleration of one sensor of a tracker."""

    type: str
    """`VELOCITY` or `ACCELERATION`."""
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
    """Rotation during `interval_s`, per second for an acceleration."""
    interval_s: float


class Ping(NamedTuple):
    """Request for a `Pong` of the same sender."""

    time_us: int
    sender: int


class Pong(NamedTuple):
    """Answer to a `Ping`."""

    time_us: int
    sender: int


class VrpnMessage(NamedTuple):
    """Message without a class of its own."""

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
    """Datagram with which a client of a classic connection asks the server to connect back."""

    host: str
    """Address as the client knows it; servers use the source address of the datagram."""
    port: int
    """TCP port on which the client listens."""


def decode_announcement(datagram: bytes) -> Announcement | CorruptBytes:
    """Return the announcement in a datagram; never raises.

    Like the reference implementation, it rejects ports below 1024 and hosts with characters other
    than letters, digits and dots.
    """
    found = _ANNOUNCED.fullmatch(datagram)
    if found is None:
        return CorruptBytes(len(datagram), "no announcement of a client")
    port = int(found[2])
    if not LOWEST_PORT <= port <= 0xFFFF:  # noqa: PLR2004 - highest port
        return CorruptBytes(len(datagram), f"port outside {LOWEST_PORT}..65535")
    return Announcement(found[1].decode(), port)
