"""Objects of the Vicon DataStream: ``u32 id, u32 length, body``.

A string is a u32 length, followed by bytes. A vector or a set is a u32 count, followed by items. A
map is a u32 count, followed by pairs. Positions are in millimetres. Rotation matrices are in
row-major order, from segment to world.

*Static* objects describe subjects, and are sent after a change. *Dynamic* objects belong to a
frame.
"""

from __future__ import annotations

from enum import IntEnum
from struct import Struct
from typing import NamedTuple

HEADER = Struct("<II")
"""Layout of the header of a packet or object: id and length."""
PACKET = 0x1A2B0001
"""Id that marks a packet."""
LARGEST_PACKET = 16 << 20
"""Largest accepted packet, bytes."""
TICKS_PER_S = 135_000_000
"""Number of ticks per second. The server states the frame period in these ticks."""


class ObjectId(IntEnum):
    """Ids of the objects whose content is read."""

    STREAM_INFO = 1
    SUBJECT_INFO = 2
    FRAME_INFO = 5
    LABELED_RECONS = 6
    LOCAL_SEGMENTS = 8
    GLOBAL_SEGMENTS = 9
    TIMECODE = 23
    LATENCY_INFO = 26
    HARDWARE_FRAME = 36
    APPLICATION_INFO = 37
    FRAME_RATES = 39
    OBJECT_QUALITY = 40
    PING = 42
    LIGHT_SEGMENTS = 901
    OBJECT_ENUMS = 100_001
    REQUEST_FRAME = 100_002
    KEEP_ALIVE = 100_003
    CONTENTS = 100_004


STATIC = frozenset((1, 2, 28, 29, 37, 40, 28_001))
"""Ids of the objects that describe the subjects and the stream."""
DYNAMIC = frozenset((5, 6, 7, 8, 9, 23, 26, 36, 39, 901))
"""Ids of the objects that belong to one frame."""
REQUESTS = frozenset((100_005, 100_006, 100_007, 100_008))
"""Ids of client requests that this project does not send."""


class StreamInfo(NamedTuple):
    """Period of the frames."""

    period: int
    """Frame period in ticks of 1 / `TICKS_PER_S`."""


class SegmentInfo(NamedTuple):
    """One segment of a subject."""

    parent: int
    """Id of the parent segment; 0 for the root."""
    id: int
    name: str


class MarkerInfo(NamedTuple):
    """One marker of a subject."""

    id: int
    name: str


class SubjectInfo(NamedTuple):
    """One subject: a person or a prop."""

    subject: int
    name: str
    segments: tuple[SegmentInfo, ...]
    markers: tuple[MarkerInfo, ...]
    attachments: tuple[tuple[int, int], ...] = ()
    """Pairs of a marker and the segment to which it is attached."""


class FrameInfo(NamedTuple):
    """Number of the frame, counted from 0."""

    number: int


class LabeledRecon(NamedTuple):
    """Position of one labeled marker."""

    subject: int
    marker: int
    radius: float
    x: float
    y: float
    z: float


class LabeledRecons(NamedTuple):
    """Positions of all visible labeled markers, mm."""

    recons: tuple[LabeledRecon, ...]


class SegmentPose(NamedTuple):
    """Pose of one segment."""

    segment: int
    position: tuple[float, float, float]
    """Position, mm."""
    rotation: tuple[float, ...]
    """Nine elements of the rotation matrix, by rows."""


class Segments(NamedTuple):
    """Poses of all segments of one subject. A subject that is not visible has no such object."""

    id: int
    """`ObjectId.GLOBAL_SEGMENTS`, or ``LOCAL_SEGMENTS`` for poses relative to the parent."""
    subject: int
    segments: tuple[SegmentPose, ...]


class LightSegment(NamedTuple):
    """Pose of one segment relative to its parent: position in mm, rotation vector in rad."""

    segment: int
    x: float
    y: float
    z: float
    rx: float
    ry: float
    rz: float


class LightSegments(NamedTuple):
    """Poses of all segments of one subject, in 32-bit numbers."""

    subject: int
    segments: tuple[LightSegment, ...]


class StreamTimecode(NamedTuple):
    """Timecode of the frame."""

    hours: int
    minutes: int
    seconds: int
    frames: int
    subframes: int
    subframes_per_frame: int
    standard: int
    """Video standard: 0 PAL, 1 NTSC, 2 drop frame, 3 film, 4 NTSC film, 5 ATSC. 0xFFFFFFFF means
    none."""
    user_bits: int = 0
    field: int = 0


class LatencyInfo(NamedTuple):
    """Processing stages, each with its duration, s."""

    stages: tuple[tuple[str, float], ...]


class HardwareFrame(NamedTuple):
    """Number of the frame according to the cameras."""

    number: int


class ApplicationInfo(NamedTuple):
    """Vertical axis of the world: 0 z up, 1 y up."""

    orientation: int


class FrameRates(NamedTuple):
    """Frame rates by name, Hz."""

    rates: tuple[tuple[str, float], ...]


class ObjectQuality(NamedTuple):
    """Quality of the tracking of one subject, from 0 to 1."""

    subject: int
    quality: float


class ViconPing(NamedTuple):
    """Ping from a client, or the same object as the server's answer."""

    number: int


class ObjectEnums(NamedTuple):
    """Ids of objects that the server can send, or that the client requests."""

    ids: frozenset[int]


class RequestFrame(NamedTuple):
    """Request for one frame or for all frames."""

    stream: bool


class KeepAlive(NamedTuple):
    """An object without content."""


class Contents(NamedTuple):
    """Ids of the objects in the frame, and ids of unchanged objects."""

    present: tuple[tuple[int, int], ...]
    """Id and number of the objects of each type."""
    unchanged: frozenset[int]


class OpaqueObject(NamedTuple):
    """An object whose content is not read."""

    id: int
    data: bytes


Object = (
    StreamInfo
    | SubjectInfo
    | FrameInfo
    | LabeledRecons
    | Segments
    | LightSegments
    | StreamTimecode
    | LatencyInfo
    | HardwareFrame
    | ApplicationInfo
    | FrameRates
    | ObjectQuality
    | ViconPing
    | ObjectEnums
    | RequestFrame
    | KeepAlive
    | Contents
    | OpaqueObject
)
