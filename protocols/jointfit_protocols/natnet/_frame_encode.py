"""Encoder of NatNet FRAMEOFDATA, for simulators and tests.

Invariant: encoding a frame that `decode_frame` decoded returns the bytes of the real server.
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
    TICKED,
    TWO_LAYOUT,
    Analog,
    FrameOfData,
    Version,
    is_supported,
)
from jointfit_protocols.natnet._frame_2x import put_frame_2x

if TYPE_CHECKING:
    import struct
    from collections.abc import Iterable


def encode_frame(frame: FrameOfData, version: Version) -> bytes:
    """Return the payload of `frame` in bitstream `version`, without the message header.

    Raises
    ------
    ValueError
        The bitstream is older than 2.5, or has no field for some content of the frame.
    struct.error
        A value is out of the range of its field.
    """
    if not is_supported(version):
        raise ValueError(f"bitstream {version[0]}.{version[1]} cannot be encoded")

    if version < TICKED:
        return put_frame_2x(frame, version, _put_analog)
    sized = version >= SIZED
    if not sized and frame.assets:
        raise ValueError("assets exist from bitstream 4.1 on")
    if frame.precision is None and sized:
        frame = frame._replace(precision=(0, 0))

    sections = [
        [put_text(one.name) + _put_items(one.positions, XYZ) for one in frame.marker_sets],
        [XYZ.pack(*position) for position in frame.other_markers],
        [BODY_LAYOUT.pack(*body) for body in frame.bodies],
        [I32.pack(one.id) + _put_items(one.bones, BODY_LAYOUT) for one in frame.skeletons],
        [MARKER_LAYOUT.pack(*marker) for marker in frame.markers],
        [_put_analog(plate) for plate in frame.force_plates],
        [_put_analog(device) for device in frame.devices],
    ]
    if sized:
        assets = [
            I32.pack(one.id)
            + _put_items(one.bodies, BODY_LAYOUT)
            + _put_items(one.markers, MARKER_LAYOUT)
            for one in frame.assets
        ]
        sections.insert(4, assets)

    parts = [I32.pack(frame.number)]
    for items in sections:
        body = b"".join(items)
        parts.append(TWO_LAYOUT.pack(len(items), len(body)) if sized else I32.pack(len(items)))
        parts.append(body)

    stamps = (frame.timestamp, frame.exposure, frame.received, frame.transmit)
    parts.append(STAMPS_LAYOUT.pack(frame.timecode, frame.subframe, *stamps))
    if frame.precision is not None:
        parts.append(PRECISION_LAYOUT.pack(*frame.precision))
    parts.append(END_LAYOUT.pack(frame.params, 0))
    return b"".join(parts)


def _put_items(items: Iterable[tuple[Any, ...]], layout: struct.Struct) -> bytes:
    packed = [layout.pack(*item) for item in items]
    return I32.pack(len(packed)) + b"".join(packed)


def _put_analog(analog: Analog) -> bytes:
    channels = [
        _put_items(((value,) for value in values), FLOAT_LAYOUT) for values in analog.channels
    ]
    return TWO_LAYOUT.pack(analog.id, len(channels)) + b"".join(channels)
