"""Encoder of NatNet FRAMEOFDATA, for simulators and tests.

Invariant: a frame of a real server that `decode_frame` has decoded is encoded byte for byte.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_protocols.natnet._cursor import I32, XYZ, put_text
from jointfit_protocols.natnet._frame import (
    BODY_LAYOUT,
    END_LAYOUT,
    FLOAT_LAYOUT,
    MARKER_LAYOUT,
    PRECISION_LAYOUT,
    SIZED,
    STAMPS_LAYOUT,
    TWO_LAYOUT,
    Analog,
    Asset,
    Body,
    FrameOfData,
    LabeledMarker,
    MarkerSet,
    Position,
    Skeleton,
    Version,
    supported,
)

if TYPE_CHECKING:
    import struct
    from collections.abc import Callable, Iterable


def encode_frame(frame: FrameOfData, version: Version) -> bytes:
    """Return the payload (without message header) of `frame` in bitstream `version`.

    Raises
    ------
    ValueError
        The bitstream is older than 3.0, or has no field for something in the frame.
    struct.error
        A value exceeds its field.
    """
    if not supported(version):
        raise ValueError(f"bitstream {version[0]}.{version[1]} is not written")

    sized = version >= SIZED
    if not sized and frame.assets:
        raise ValueError("assets exist from bitstream 4.1 on")
    if frame.precision is None and sized:
        frame = frame._replace(precision=(0, 0))

    tail = b"" if frame.precision is None else PRECISION_LAYOUT.pack(*frame.precision)

    sections: list[tuple[Iterable[Any], Callable[[Any], bytes]]] = [
        (frame.marker_sets, _put_set),
        (frame.other_markers, _put_position),
        (frame.bodies, _put_body),
        (frame.skeletons, _put_skeleton),
        *([(frame.assets, _put_asset)] if sized else []),
        (frame.markers, _put_marker),
        (frame.force_plates, _put_analog),
        (frame.devices, _put_analog),
    ]

    stamps = (frame.timestamp, frame.exposure, frame.received, frame.transmit)
    return b"".join(
        (
            I32.pack(frame.number),
            *(_put_section([put(item) for item in items], sized) for items, put in sections),
            STAMPS_LAYOUT.pack(frame.timecode, frame.subframe, *stamps),
            tail,
            END_LAYOUT.pack(frame.params, 0),
        )
    )


def _put_section(items: list[bytes], sized: bool) -> bytes:
    body = b"".join(items)
    head = TWO_LAYOUT.pack(len(items), len(body)) if sized else I32.pack(len(items))
    return head + body


def _put_items(items: Iterable[tuple[Any, ...]], layout: struct.Struct) -> bytes:
    packed = [layout.pack(*item) for item in items]
    return I32.pack(len(packed)) + b"".join(packed)


def _put_set(marker_set: MarkerSet) -> bytes:
    return put_text(marker_set.name) + _put_items(marker_set.positions, XYZ)


def _put_position(position: Position) -> bytes:
    return XYZ.pack(*position)


def _put_body(body: Body) -> bytes:
    return BODY_LAYOUT.pack(*body)


def _put_marker(marker: LabeledMarker) -> bytes:
    return MARKER_LAYOUT.pack(*marker)


def _put_skeleton(skeleton: Skeleton) -> bytes:
    return I32.pack(skeleton.id) + _put_items(skeleton.bones, BODY_LAYOUT)


def _put_asset(asset: Asset) -> bytes:
    bodies = _put_items(asset.bodies, BODY_LAYOUT)
    return I32.pack(asset.id) + bodies + _put_items(asset.markers, MARKER_LAYOUT)


def _put_analog(analog: Analog) -> bytes:
    channels = [
        _put_items(((value,) for value in values), FLOAT_LAYOUT) for values in analog.channels
    ]
    return TWO_LAYOUT.pack(analog.id, len(channels)) + b"".join(channels)
