"""Encoding and decoding of the objects of the Vicon DataStream.

The *body* of an object consists of its bytes after the header.

Invariant: a count or length is compared with the number of remaining bytes before anything is read.
Time and memory are therefore proportional to the size of the body. Bytes after the known content of
a body are ignored, because newer servers append fields.
"""

from __future__ import annotations

from struct import Struct
from typing import TYPE_CHECKING

from jointfit_protocols.vicon._messages import (
    ApplicationInfo,
    Contents,
    FrameInfo,
    FrameRates,
    HardwareFrame,
    KeepAlive,
    LabeledRecon,
    LabeledRecons,
    LatencyInfo,
    LightSegment,
    LightSegments,
    MarkerInfo,
    Object,
    ObjectEnums,
    ObjectId,
    ObjectQuality,
    OpaqueObject,
    RequestFrame,
    SegmentInfo,
    SegmentPose,
    Segments,
    StreamInfo,
    StreamTimecode,
    SubjectInfo,
    ViconPing,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

_LONGEST_NAME = 255
_U32 = Struct("<I")
_I8 = Struct("<b")
_PAIR = Struct("<II")
_I64 = Struct("<q")
_U64 = Struct("<Q")
_RECON = Struct("<II13dI")
_SEGMENT = Struct("<I12d")
_LIGHT_SEGMENT = Struct("<I6f")
_SEGMENT_INFO = Struct("<II24x")
_TIMECODE = Struct("<BBBBHHIIB")
_QUALITY = Struct("<Id")
_F64 = Struct("<d")
_NO_COVARIANCE = (0.0,) * 9
_EMPTY_STRING = 4
"""Length of an empty string, bytes."""

OPTIONAL = frozenset((
    ObjectId.STREAM_INFO, ObjectId.TIMECODE, ObjectId.LATENCY_INFO, ObjectId.HARDWARE_FRAME,
    ObjectId.APPLICATION_INFO, ObjectId.FRAME_RATES, ObjectId.OBJECT_QUALITY, ObjectId.PING,
    ObjectId.SUBJECT_INFO,
))  # fmt: skip
"""Objects that are not needed for poses or markers. Servers of other versions may send only a part
of such an object."""


class _BodyError(Exception):
    """A body ends before its content is complete. The exception does not leave this module."""


class _Cursor:
    """Reading position in a body."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._at = 0

    def take(self, layout: Struct) -> tuple[int | float, ...]:
        """Read the numbers of a layout."""
        if layout.size > self._left:
            raise _BodyError(f"{layout.size} bytes needed, {self._left} left")
        found = layout.unpack_from(self._data, self._at)
        self._at += layout.size
        return found

    def integer(self, layout: Struct = _U32) -> int:
        """Read one integer."""
        return int(self.take(layout)[0])

    def count(self, least: int) -> int:
        """Read the number of items that have at least `least` bytes each."""
        found = self.integer()
        if found * least > self._left:
            raise _BodyError(f"{found} items in {self._left} bytes")
        return found

    def items(self, layout: Struct) -> Iterable[tuple[int | float, ...]]:
        """Read the items of a vector with a fixed layout."""
        size = self.count(layout.size) * layout.size
        begin, self._at = self._at, self._at + size
        return layout.iter_unpack(self._data[begin : self._at])

    def text(self) -> str:
        """Read a string, truncated after `_LONGEST_NAME` bytes."""
        size = self.count(1)
        begin, self._at = self._at, self._at + size
        raw = bytes(self._data[begin : min(self._at, begin + _LONGEST_NAME)])
        return raw.split(b"\0", 1)[0].decode("utf-8", "replace")

    @property
    def ended(self) -> bool:
        """Whether the whole body has been read."""
        return not self._left

    @property
    def _left(self) -> int:
        return len(self._data) - self._at


def decode_object(kind: int, data: memoryview) -> Object | str:
    """Return the object with the id `kind`, or the reason why its body is corrupt.

    An optional object whose body is shorter than expected becomes an `OpaqueObject`.
    """
    read = _READERS.get(kind)
    if read is None:
        return OpaqueObject(kind, bytes(data))
    try:
        return read(_Cursor(data))
    except _BodyError as error:
        if kind in OPTIONAL:
            return OpaqueObject(kind, bytes(data))
        return f"object {kind}: {error}"


# --- readers --------------------------------------------------------------------------------------


def _subject(cursor: _Cursor) -> SubjectInfo:
    number, name = cursor.integer(), cursor.text()
    segments = []
    for _ in range(cursor.count(_SEGMENT_INFO.size + _EMPTY_STRING)):
        parent, segment = cursor.take(_SEGMENT_INFO)
        segments.append(SegmentInfo(int(parent), int(segment), cursor.text()))
    # Servers of other versions may omit the markers, or the attachments of markers, at the end.
    markers = [
        MarkerInfo(cursor.integer(), cursor.text())
        for _ in range(0 if cursor.ended else cursor.count(_U32.size + _EMPTY_STRING))
    ]
    pairs = () if cursor.ended else cursor.items(_PAIR)
    attached = tuple((int(marker), int(segment)) for marker, segment in pairs)
    return SubjectInfo(number, name, tuple(segments), tuple(markers), attached)


def _recons(cursor: _Cursor) -> LabeledRecons:
    return LabeledRecons(
        tuple(
            LabeledRecon(int(item[0]), int(item[1]), item[2], item[3], item[4], item[5])
            for item in cursor.items(_RECON)
        )
    )


def _segments(kind: int) -> Callable[[_Cursor], Segments]:
    def read(cursor: _Cursor) -> Segments:
        subject = cursor.integer()
        poses = tuple(
            SegmentPose(int(item[0]), (item[1], item[2], item[3]), item[4:])
            for item in cursor.items(_SEGMENT)
        )
        return Segments(kind, subject, poses)

    return read


def _light_segments(cursor: _Cursor) -> LightSegments:
    subject = cursor.integer()
    poses = tuple(LightSegment(int(item[0]), *item[1:]) for item in cursor.items(_LIGHT_SEGMENT))
    return LightSegments(subject, poses)


def _named_numbers(cursor: _Cursor) -> tuple[tuple[str, float], ...]:
    return tuple(
        (cursor.text(), cursor.take(_F64)[0])
        for _ in range(cursor.count(_EMPTY_STRING + _F64.size))
    )


def _contents(cursor: _Cursor) -> Contents:
    present = tuple((int(kind), int(count)) for kind, count in cursor.items(_PAIR))
    return Contents(present, frozenset(int(kind) for (kind,) in cursor.items(_U32)))


def _timecode(cursor: _Cursor) -> StreamTimecode:
    return StreamTimecode(*(int(value) for value in cursor.take(_TIMECODE)))


def _quality(cursor: _Cursor) -> ObjectQuality:
    subject, quality = cursor.take(_QUALITY)
    return ObjectQuality(int(subject), quality)


_READERS: dict[int, Callable[[_Cursor], Object]] = {
    ObjectId.STREAM_INFO: lambda cursor: StreamInfo(cursor.integer(_I64)),
    ObjectId.SUBJECT_INFO: _subject,
    ObjectId.FRAME_INFO: lambda cursor: FrameInfo(cursor.integer()),
    ObjectId.LABELED_RECONS: _recons,
    ObjectId.LOCAL_SEGMENTS: _segments(ObjectId.LOCAL_SEGMENTS),
    ObjectId.GLOBAL_SEGMENTS: _segments(ObjectId.GLOBAL_SEGMENTS),
    ObjectId.LIGHT_SEGMENTS: _light_segments,
    ObjectId.TIMECODE: _timecode,
    ObjectId.LATENCY_INFO: lambda cursor: LatencyInfo(_named_numbers(cursor)),
    ObjectId.HARDWARE_FRAME: lambda cursor: HardwareFrame(cursor.integer()),
    ObjectId.APPLICATION_INFO: lambda cursor: ApplicationInfo(cursor.integer(_I8)),
    ObjectId.FRAME_RATES: lambda cursor: FrameRates(_named_numbers(cursor)),
    ObjectId.OBJECT_QUALITY: _quality,
    ObjectId.PING: lambda cursor: ViconPing(cursor.integer(_U64)),
    ObjectId.OBJECT_ENUMS: lambda cursor: ObjectEnums(
        frozenset(int(kind) for (kind,) in cursor.items(_U32))
    ),
    ObjectId.REQUEST_FRAME: lambda cursor: RequestFrame(bool(cursor.integer(_I8))),
    ObjectId.KEEP_ALIVE: lambda _: KeepAlive(),
    ObjectId.CONTENTS: _contents,
}


# --- writers --------------------------------------------------------------------------------------


def encode_object(item: Object) -> tuple[int, bytes]:
    """Return the id and the body of an object."""
    if isinstance(item, OpaqueObject):
        return item.id, item.data
    if isinstance(item, Segments):
        return item.id, _U32.pack(item.subject) + _vector(
            _SEGMENT.pack(pose.segment, *pose.position, *pose.rotation) for pose in item.segments
        )
    kind, write = _WRITERS[type(item)]
    return kind, write(item)


def _vector(items: Iterable[bytes]) -> bytes:
    found = list(items)
    return _U32.pack(len(found)) + b"".join(found)


def _string(text: str) -> bytes:
    raw = text.encode()
    return _U32.pack(len(raw)) + raw


def _write_subject(item: SubjectInfo) -> bytes:
    return (
        _U32.pack(item.subject)
        + _string(item.name)
        + _vector(_SEGMENT_INFO.pack(s.parent, s.id) + _string(s.name) for s in item.segments)
        + _vector(_U32.pack(marker.id) + _string(marker.name) for marker in item.markers)
        + _vector(_PAIR.pack(*pair) for pair in item.attachments)
    )


def _write_recons(item: LabeledRecons) -> bytes:
    return _vector(_RECON.pack(*recon, *_NO_COVARIANCE, 0) for recon in item.recons)


def _write_light_segments(item: LightSegments) -> bytes:
    return _U32.pack(item.subject) + _vector(_LIGHT_SEGMENT.pack(*s) for s in item.segments)


def _write_numbers(numbers: tuple[tuple[str, float], ...]) -> bytes:
    return _vector(_string(name) + _F64.pack(value) for name, value in numbers)


def _write_contents(item: Contents) -> bytes:
    return _vector(_PAIR.pack(*pair) for pair in item.present) + _vector(
        map(_U32.pack, sorted(item.unchanged))
    )


_WRITERS: dict[type, tuple[int, Callable[..., bytes]]] = {
    StreamInfo: (ObjectId.STREAM_INFO, lambda item: _I64.pack(*item)),
    SubjectInfo: (ObjectId.SUBJECT_INFO, _write_subject),
    FrameInfo: (ObjectId.FRAME_INFO, lambda item: _U32.pack(*item)),
    LabeledRecons: (ObjectId.LABELED_RECONS, _write_recons),
    LightSegments: (ObjectId.LIGHT_SEGMENTS, _write_light_segments),
    StreamTimecode: (ObjectId.TIMECODE, lambda item: _TIMECODE.pack(*item)),
    LatencyInfo: (ObjectId.LATENCY_INFO, lambda item: _write_numbers(item.stages)),
    HardwareFrame: (ObjectId.HARDWARE_FRAME, lambda item: _U32.pack(*item)),
    ApplicationInfo: (ObjectId.APPLICATION_INFO, lambda item: _I8.pack(*item)),
    FrameRates: (ObjectId.FRAME_RATES, lambda item: _write_numbers(item.rates)),
    ObjectQuality: (ObjectId.OBJECT_QUALITY, lambda item: _QUALITY.pack(*item)),
    ViconPing: (ObjectId.PING, lambda item: _U64.pack(*item)),
    ObjectEnums: (ObjectId.OBJECT_ENUMS, lambda item: _vector(map(_U32.pack, sorted(item.ids)))),
    RequestFrame: (ObjectId.REQUEST_FRAME, lambda item: _I8.pack(item.stream)),
    KeepAlive: (ObjectId.KEEP_ALIVE, lambda _: b""),
    Contents: (ObjectId.CONTENTS, _write_contents),
}
