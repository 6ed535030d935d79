"""NatNet FRAMEOFDATA in bitstreams 3.0 to 4.x, without conversion of units or names.

    number | marker sets | other markers | bodies | skeletons | assets | labeled | plates | devices
    timecode | sub-frame | timestamp | exposure | received | transmit | [precision] | params | 0

Numbers are little-endian and packed. Each section starts with the number of its items (``i32 n``).
From bitstream 4.1 on, the size of the items follows (``i32 bytes``), and the section assets exists.
Positions are in metres in the server's world, and quaternions have the order x, y, z, w.

Source: NaturalPoint NatNet SDK 4.1, NatNetTypes.h and PythonClient.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

from jointfit_protocols.natnet._cursor import XYZ, Cursor, MalformedError

Version = tuple[int, int]
"""Bitstream version in use: major and minor number."""

Position = tuple[float, float, float]

SectionReader = Callable[[Cursor, int], tuple[Any, ...]]
"""Function that reads the items of one section. Its second argument is the number of items."""

OLDEST: Version = (2, 5)
TICKED: Version = (3, 0)
"""First bitstream whose frames contain server ticks. `_frame_2x` reads older frames."""
SIZED: Version = (4, 1)
"""First bitstream whose sections contain their size in bytes."""

BODY_TRACKED = 0x01
MARKER_OCCLUDED = 0x01
MARKER_POINT_CLOUD_SOLVED = 0x02
MARKER_HAS_MODEL = 0x08
FRAME_MODEL_CHANGED = 0x02
FRAME_EDIT_MODE = 0x04
FRAME_BITSTREAM_CHANGED = 0x08

BODY_LAYOUT = struct.Struct("<i3f4ffh")
MARKER_LAYOUT = struct.Struct("<i3ffhf")
FLOAT_LAYOUT = struct.Struct("<f")
TWO_LAYOUT = struct.Struct("<ii")
STAMPS_LAYOUT = struct.Struct("<IIdQQQ")
PRECISION_LAYOUT = struct.Struct("<II")
END_LAYOUT = struct.Struct("<hi")
_SHORT_TAIL = END_LAYOUT.size
_LONG_TAIL = PRECISION_LAYOUT.size + END_LAYOUT.size


class Body(NamedTuple):
    """Pose of one rigid body or bone (38 bytes). The id of a bone is ``skeleton << 16 | bone``."""

    id: int
    x: float
    y: float
    z: float
    qx: float
    qy: float
    qz: float
    qw: float
    error: float
    """Mean marker error, m. A small error does not show that the pose is valid; `params` does."""
    params: int
    """Flags. Bit 0 means tracked; if it is clear, the last valid pose is repeated."""


class LabeledMarker(NamedTuple):
    """One labeled marker (26 bytes).

    Its id is ``model << 16 | member``. The model is 0 if the marker belongs to no model.
    """

    id: int
    x: float
    y: float
    z: float
    size: float
    params: int
    """Flags, see the constants ``MARKER_``. A usable marker is not occluded, and has the flag
    `MARKER_POINT_CLOUD_SOLVED`."""
    residual: float
    """Residual of the marker, metres per camera ray."""


class MarkerSet(NamedTuple):
    """Positions of one marker set, in the order of its description. (0, 0, 0) means missing."""

    name: str
    positions: tuple[Position, ...]


class Skeleton(NamedTuple):
    """One skeleton with its bones."""

    id: int
    bones: tuple[Body, ...]


class Asset(NamedTuple):
    """One trained marker set (bitstream 4.1 and later)."""

    id: int
    bodies: tuple[Body, ...]
    markers: tuple[LabeledMarker, ...]


class Analog(NamedTuple):
    """Samples of one force plate or analog device, with a tuple for each channel."""

    id: int
    channels: tuple[tuple[float, ...], ...]


class FrameOfData(NamedTuple):
    """One camera frame, with the values as sent."""

    number: int
    timestamp: float
    """Frame number times the nominal period, s. It is not a clock."""
    exposure: int
    """Center of the camera exposure, server ticks; 0 for USB cameras."""
    received: int
    transmit: int
    params: int = 0
    bodies: tuple[Body, ...] = ()
    markers: tuple[LabeledMarker, ...] = ()
    marker_sets: tuple[MarkerSet, ...] = ()
    other_markers: tuple[Position, ...] = ()
    skeletons: tuple[Skeleton, ...] = ()
    assets: tuple[Asset, ...] = ()
    force_plates: tuple[Analog, ...] = ()
    devices: tuple[Analog, ...] = ()
    timecode: int = 0
    subframe: int = 0
    precision: tuple[int, int] | None = None
    """Seconds and fraction of an external clock; None if the bitstream has no such field."""
    skipped: tuple[str, ...] = ()
    """Names of sections that were skipped by their size because their content is unknown."""


def is_supported(version: Version) -> bool:
    """Return whether frames of this bitstream can be decoded: it must be 2.5 or newer."""
    return version >= OLDEST


def read_frame(cursor: Cursor, sized: bool) -> FrameOfData:
    """Read one frame. The remaining length shows whether it contains a precision timestamp."""
    number = cursor.integer()
    skipped: list[str] = []
    sections = {
        name: _read_section(cursor, name, smallest, read, skipped if sized else None)
        for name, smallest, read in (_SECTIONS_SIZED if sized else _SECTIONS)
    }

    tail = STAMPS_LAYOUT.size + _LONG_TAIL
    while sized and cursor.left > tail:  # a newer bitstream has further sections
        _, size = cursor.unpack(TWO_LAYOUT)
        cursor.window(size, lambda: None)
        skipped.append("unknown")

    timecode, subframe, timestamp, exposure, received, transmit = cursor.unpack(STAMPS_LAYOUT)
    precision = cursor.unpack(PRECISION_LAYOUT) if cursor.left == _LONG_TAIL else None
    if cursor.left != _SHORT_TAIL:
        raise MalformedError(f"{cursor.left} bytes left for the end, expected {_SHORT_TAIL}")

    params, end = cursor.unpack(END_LAYOUT)
    if end:
        raise MalformedError("no end tag")
    return FrameOfData(
        number, timestamp, exposure, received, transmit, params,
        timecode=timecode, subframe=subframe, precision=precision, skipped=tuple(skipped),
        **sections,
    )  # fmt: skip


def _read_section(
    cursor: Cursor,
    name: str,
    smallest: int,
    read: SectionReader,
    skipped: list[str] | None,
) -> tuple[Any, ...]:
    """Read one section.

    If `skipped` is given, skip a section that does not have its stated size, and append its name.
    """
    n = cursor.integer()
    if skipped is None:
        cursor.check(n, smallest)
        return read(cursor, n) if n else ()

    size = cursor.integer()
    if n == 0 and size == 0:
        return ()

    def items() -> tuple[Any, ...]:
        cursor.check(n, smallest)
        return read(cursor, n)

    found: tuple[Any, ...] | None = cursor.window(size, items)
    if found is None:
        skipped.append(name)
        return ()
    return found


def _read_bodies(cursor: Cursor, n: int) -> tuple[Body, ...]:
    return tuple(map(Body._make, cursor.records(BODY_LAYOUT, n)))


def _read_markers(cursor: Cursor, n: int) -> tuple[LabeledMarker, ...]:
    return tuple(map(LabeledMarker._make, cursor.records(MARKER_LAYOUT, n)))


def _read_analog(cursor: Cursor) -> Analog:
    number = cursor.integer()
    channels = (cursor.records(FLOAT_LAYOUT, cursor.integer()) for _ in range(cursor.count(4)))
    return Analog(number, tuple(tuple(value for (value,) in channel) for channel in channels))


def read_analogs(cursor: Cursor, n: int) -> tuple[Analog, ...]:
    """Read `n` force plates or analog devices."""
    return tuple(_read_analog(cursor) for _ in range(n))


def _items(read: Callable[[Cursor], Any]) -> SectionReader:
    """Return the reader of a section whose items have different sizes."""
    return lambda cursor, n: tuple(read(cursor) for _ in range(n))


# Name, smallest item (bytes), and reader of each section, in the order on the wire.
_SECTIONS: tuple[tuple[str, int, SectionReader], ...] = (
    ("marker_sets", 5, _items(lambda c: MarkerSet(c.text(), tuple(c.records(XYZ, c.integer()))))),
    ("other_markers", XYZ.size, lambda cursor, n: tuple(cursor.records(XYZ, n))),
    ("bodies", BODY_LAYOUT.size, _read_bodies),
    ("skeletons", 8, _items(lambda c: Skeleton(c.integer(), _read_bodies(c, c.integer())))),
    ("markers", MARKER_LAYOUT.size, _read_markers),
    ("force_plates", 8, read_analogs),
    ("devices", 8, read_analogs),
)
_ASSETS = _items(
    lambda c: Asset(c.integer(), _read_bodies(c, c.integer()), _read_markers(c, c.integer()))
)
_SECTIONS_SIZED = (*_SECTIONS[:4], ("assets", 12, _ASSETS), *_SECTIONS[4:])
