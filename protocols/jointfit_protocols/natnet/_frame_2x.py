"""NatNet FRAMEOFDATA in bitstreams 2.5 to 2.x, in both directions.

    number | marker sets | other markers | bodies | skeletons | labeled | [plates] | [devices]
    latency | timecode | sub-frame | [timestamp] | [params] | 0

| from version | content |
|---|---|
| all | a body has ``i32 n``, n positions, n ids and n sizes of its markers before its mean error |
| 2.6 | i16 params of bodies, labeled markers and frame; timestamp as f32, from 2.7 as f64 |
| 2.9, 2.11 | force plates, devices |

There are no server ticks. Before version 2.6, no flag marks a body that is not tracked. A body at
the origin without an orientation counts as not tracked.

Source: NaturalPoint NatNet SDK 4.1, PythonClient.

Invariant: `read_frame_2x` inverts `put_frame_2x`. The markers inside bodies are skipped.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from jointfit_protocols.natnet._cursor import I32, XYZ, Cursor, MalformedError, put_text
from jointfit_protocols.natnet._frame import (
    BODY_TRACKED,
    MARKER_POINT_CLOUD_SOLVED,
    Body,
    FrameOfData,
    LabeledMarker,
    MarkerSet,
    Skeleton,
    Version,
    read_analogs,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from jointfit_protocols.natnet._frame import Analog

FLAGGED: Version = (2, 6)
"""First bitstream whose frames contain flags (``params``)."""
_LONG_TIMESTAMP: Version = (2, 7)
_PLATES: Version = (2, 9)
_DEVICES: Version = (2, 11)

_POSE = struct.Struct("<i3f4f")
_INNER_BYTES = XYZ.size + I32.size + 4
_ERROR, _FLAGGED_ERROR = struct.Struct("<f"), struct.Struct("<fh")
_MARKER, _FLAGGED_MARKER = struct.Struct("<i3ff"), struct.Struct("<i3ffh")
_CLOCK = struct.Struct("<fII")
_END, _FLAGGED_END = struct.Struct("<i"), struct.Struct("<hi")
_FLOAT, _DOUBLE = struct.Struct("<f"), struct.Struct("<d")


def read_frame_2x(cursor: Cursor, version: Version) -> FrameOfData:
    """Read one frame. Like all readers, it raises only the exceptions in `BREAKS`."""
    number = cursor.integer()
    n = cursor.count(5)
    sets = tuple(
        MarkerSet(cursor.text(), tuple(cursor.records(XYZ, cursor.integer()))) for _ in range(n)
    )
    others = tuple(cursor.records(XYZ, cursor.integer()))
    bodies = _read_bodies(cursor, version)
    n = cursor.count(2 * I32.size)
    skeletons = tuple(Skeleton(cursor.integer(), _read_bodies(cursor, version)) for _ in range(n))
    markers = _read_markers(cursor, version)
    plates = read_analogs(cursor, cursor.count(8)) if version >= _PLATES else ()
    devices = read_analogs(cursor, cursor.count(8)) if version >= _DEVICES else ()

    latency, timecode, subframe = cursor.unpack(_CLOCK)
    timestamp, params = float(latency), 0
    if version >= FLAGGED:
        (timestamp,) = cursor.unpack(_DOUBLE if version >= _LONG_TIMESTAMP else _FLOAT)
        params, end = cursor.unpack(_FLAGGED_END)
    else:
        (end,) = cursor.unpack(_END)
    if end or cursor.left:
        raise MalformedError(f"{cursor.left} bytes behind the end, or no end tag")
    return FrameOfData(
        number, timestamp, 0, 0, 0, params, bodies, markers, sets, others, skeletons,
        force_plates=plates, devices=devices, timecode=timecode, subframe=subframe,
    )  # fmt: skip


def put_frame_2x(
    frame: FrameOfData, version: Version, put_analog: Callable[[Analog], bytes]
) -> bytes:
    """Return the payload of a frame without server ticks and residuals."""
    sections: list[list[bytes]] = [
        [put_text(one.name) + _put_rows(one.positions) for one in frame.marker_sets],
        [XYZ.pack(*position) for position in frame.other_markers],
        [_put_body(body, version) for body in frame.bodies],
        [
            I32.pack(one.id)
            + I32.pack(len(one.bones))
            + b"".join(_put_body(bone, version) for bone in one.bones)
            for one in frame.skeletons
        ],
        [
            _FLAGGED_MARKER.pack(*marker[:6]) if version >= FLAGGED else _MARKER.pack(*marker[:5])
            for marker in frame.markers
        ],
    ]
    sections += [list(map(put_analog, frame.force_plates))] if version >= _PLATES else []
    sections += [list(map(put_analog, frame.devices))] if version >= _DEVICES else []
    parts = [I32.pack(frame.number)]
    for items in sections:
        parts += [I32.pack(len(items)), *items]

    # Real servers write the time stamp instead of the latency.
    parts.append(_CLOCK.pack(frame.timestamp, frame.timecode, frame.subframe))
    if version >= FLAGGED:
        parts.append((_DOUBLE if version >= _LONG_TIMESTAMP else _FLOAT).pack(frame.timestamp))
        parts.append(_FLAGGED_END.pack(frame.params, 0))
    else:
        parts.append(_END.pack(0))
    return b"".join(parts)


def _read_bodies(cursor: Cursor, version: Version) -> tuple[Body, ...]:
    found = []
    for _ in range(cursor.count(_POSE.size + I32.size + 4)):
        pose = cursor.unpack(_POSE)
        n = cursor.count(_INNER_BYTES)
        cursor.at += n * _INNER_BYTES
        if version >= FLAGGED:
            error, params = cursor.unpack(_FLAGGED_ERROR)
        else:
            (error,) = cursor.unpack(_ERROR)
            params = BODY_TRACKED if any(pose[1:7]) else 0
        found.append(Body._make((*pose, error, params)))
    return tuple(found)


def _read_markers(cursor: Cursor, version: Version) -> tuple[LabeledMarker, ...]:
    n = cursor.integer()
    if version >= FLAGGED:
        return tuple(LabeledMarker._make((*r, 0.0)) for r in cursor.records(_FLAGGED_MARKER, n))
    found = []
    for row in cursor.records(_MARKER, n):
        params = MARKER_POINT_CLOUD_SOLVED if any(row[1:4]) else 0
        found.append(LabeledMarker._make((*row, params, 0.0)))
    return tuple(found)


def _put_body(body: Body, version: Version) -> bytes:
    pose = _POSE.pack(*body[:8]) + I32.pack(0)
    if version >= FLAGGED:
        return pose + _FLAGGED_ERROR.pack(body.error, body.params)
    return pose + _ERROR.pack(body.error)


def _put_rows(rows: Iterable[tuple[float, float, float]]) -> bytes:
    packed = [XYZ.pack(*row) for row in rows]
    return I32.pack(len(packed)) + b"".join(packed)
