"""Components of a data packet: markers, 6DOF bodies, skeletons and timecodes.

A component is ``u32 size, u32 type, data``. The size includes these 8 bytes. Positions are in
millimetres. Rotation matrices are in column-major order, from body to world. For a marker or body
that is not visible, all bits of its numbers are set, which is a NaN.

Invariant: a count is compared with the size of its component before anything is read. A component
of a known type is accepted only if its content ends exactly at the end of the component.
"""

from __future__ import annotations

from enum import IntEnum
from struct import Struct
from typing import NamedTuple


class ComponentType(IntEnum):
    """Types of components whose content is read. All other components are skipped by their size."""

    MARKERS = 1
    UNLABELED = 2
    BODIES = 5
    BODIES_EULER = 6
    MARKERS_RESIDUAL = 9
    UNLABELED_RESIDUAL = 10
    BODIES_RESIDUAL = 11
    BODIES_EULER_RESIDUAL = 12
    TIMECODE = 17
    SKELETON = 18


ITEM_LAYOUTS: dict[int, Struct] = {
    ComponentType.MARKERS: Struct("<3f"),
    ComponentType.MARKERS_RESIDUAL: Struct("<4f"),
    ComponentType.UNLABELED: Struct("<3fI"),
    ComponentType.UNLABELED_RESIDUAL: Struct("<3fIf"),
    ComponentType.BODIES: Struct("<12f"),
    ComponentType.BODIES_RESIDUAL: Struct("<13f"),
    ComponentType.BODIES_EULER: Struct("<6f"),
    ComponentType.BODIES_EULER_RESIDUAL: Struct("<7f"),
}
"""Layout of one marker or body, by type: position, then id, rotation or residual if the type has
them."""

COMPONENT_HEAD = Struct("<II")
"""Layout of the head of a component: size and type."""
_ITEMS_HEAD = Struct("<Ihh")
"""Layout of the head of items: number of items, 2D drop rate and out-of-sync rate."""
_COUNT = Struct("<I")
_TIMECODE = Struct("<III")
_SEGMENT = Struct("<I7f")
_MINUTES_AT, _SECONDS_AT, _FRAME_AT, _SUBFRAME_AT = 5, 11, 17, 22
_FIVE_BITS, _SIX_BITS, _NINE_BITS = 0x1F, 0x3F, 0x1FF
_YEAR_BITS, _DAY_AT, _TENTHS_BITS = 0x7F, 7, 0xF


class ItemsComponent(NamedTuple):
    """Labeled markers or bodies in the order of the XML settings of QTM, or unlabeled markers.

    Each unlabeled marker has an id.
    """

    type: int
    drop_rate: int
    """Share of frames in the last second for which cameras dropped 2D data, per mille."""
    sync_rate: int
    """Share of frames that arrived out of sync, per mille."""
    items: tuple[tuple[float, ...], ...]
    """Numbers of each item, in the layout of its type."""


class TimecodeType(IntEnum):
    """Types of timecodes."""

    SMPTE = 0
    IRIG = 1
    CAMERA = 2


class QtmTimecode(NamedTuple):
    """One timecode as sent."""

    type: int
    high: int
    low: int

    @property
    def camera_ticks(self) -> int | None:
        """Exposure on the cameras' clock, in units of 100 ns; None for other types of timecode."""
        return self.high << 32 | self.low if self.type == TimecodeType.CAMERA else None

    @property
    def text(self) -> str | None:
        """Time of day as text; None for camera time and for unknown types."""
        low = self.low
        clock = (
            f"{low & _FIVE_BITS:02}:{low >> _MINUTES_AT & _SIX_BITS:02}:"
            f"{low >> _SECONDS_AT & _SIX_BITS:02}"
        )
        if self.type == TimecodeType.SMPTE:
            frame, part = low >> _FRAME_AT & _FIVE_BITS, low >> _SUBFRAME_AT & _NINE_BITS
            return f"{clock}:{frame:02}" + (f".{part}" if part else "")
        if self.type == TimecodeType.IRIG:
            year, day = self.high & _YEAR_BITS, self.high >> _DAY_AT & _NINE_BITS
            return f"{year:02}-{day:03} {clock}.{low >> _FRAME_AT & _TENTHS_BITS}"
        return None


class TimecodeComponent(NamedTuple):
    """All timecodes of a frame."""

    timecodes: tuple[QtmTimecode, ...]
    type: int = ComponentType.TIMECODE


class SkeletonSegment(NamedTuple):
    """Pose of one segment of a skeleton: position in mm, quaternion as on the wire."""

    id: int
    x: float
    y: float
    z: float
    qx: float
    qy: float
    qz: float
    qw: float


class SkeletonComponent(NamedTuple):
    """Skeletons in the order of the XML settings of QTM.

    A skeleton that is not visible has no segments.
    """

    skeletons: tuple[tuple[SkeletonSegment, ...], ...]
    type: int = ComponentType.SKELETON


class OpaqueComponent(NamedTuple):
    """A component whose content is not decoded, such as analog or force data."""

    type: int
    data: bytes


Component = ItemsComponent | TimecodeComponent | SkeletonComponent | OpaqueComponent


def decode_component(kind: int, data: memoryview) -> Component | str:
    """Return the component of a type, or the reason why its data are corrupt."""
    layout = ITEM_LAYOUTS.get(kind)
    if layout is not None:
        if len(data) < _ITEMS_HEAD.size:
            return f"component {kind}: {len(data)} bytes without a count"
        count, drop_rate, sync_rate = _ITEMS_HEAD.unpack_from(data)
        if count * layout.size != len(data) - _ITEMS_HEAD.size:
            return f"component {kind}: {count} items in {len(data)} bytes"
        items = tuple(layout.iter_unpack(data[_ITEMS_HEAD.size :]))
        return ItemsComponent(kind, drop_rate, sync_rate, items)

    if kind == ComponentType.TIMECODE:
        return _decode_timecodes(data)
    if kind == ComponentType.SKELETON:
        return _decode_skeletons(data)
    return OpaqueComponent(kind, bytes(data))


def _decode_timecodes(data: memoryview) -> TimecodeComponent | str:
    if len(data) < _COUNT.size:
        return "timecode without a count"
    (count,) = _COUNT.unpack_from(data)
    if count * _TIMECODE.size != len(data) - _COUNT.size:
        return f"{count} timecodes in {len(data)} bytes"
    return TimecodeComponent(
        tuple(map(QtmTimecode._make, _TIMECODE.iter_unpack(data[_COUNT.size :])))
    )


def _decode_skeletons(data: memoryview) -> SkeletonComponent | str:
    if len(data) < _COUNT.size:
        return "skeletons without a count"
    (count,) = _COUNT.unpack_from(data)
    at = _COUNT.size
    if count * _COUNT.size > len(data) - at:
        return f"{count} skeletons in {len(data)} bytes"

    found = []
    for _ in range(count):
        if len(data) - at < _COUNT.size:
            return "skeletons end before their last one"
        (segments,) = _COUNT.unpack_from(data, at)
        at += _COUNT.size
        end = at + segments * _SEGMENT.size
        if end > len(data):
            return f"{segments} segments in {len(data) - at} bytes"
        found.append(tuple(map(SkeletonSegment._make, _SEGMENT.iter_unpack(data[at:end]))))
        at = end
    if at != len(data):
        return f"{len(data) - at} bytes after the last skeleton"
    return SkeletonComponent(tuple(found))


def encode_component(component: Component) -> bytes:
    """Return the bytes of a component, including its header."""
    kind, data = component.type, b""
    match component:
        case ItemsComponent(kind, drop_rate, sync_rate, items):
            layout = ITEM_LAYOUTS[kind]
            head = _ITEMS_HEAD.pack(len(items), drop_rate, sync_rate)
            data = head + b"".join(layout.pack(*item) for item in items)
        case TimecodeComponent(timecodes, kind):
            data = _COUNT.pack(len(timecodes)) + b"".join(_TIMECODE.pack(*t) for t in timecodes)
        case SkeletonComponent(skeletons, kind):
            data = _COUNT.pack(len(skeletons)) + b"".join(
                _COUNT.pack(len(segments)) + b"".join(_SEGMENT.pack(*s) for s in segments)
                for segments in skeletons
            )
        case OpaqueComponent():
            data = component.data
    return COMPONENT_HEAD.pack(COMPONENT_HEAD.size + len(data), kind) + data
