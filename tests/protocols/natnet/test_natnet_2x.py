"""Frames and models of bitstreams 2.5 to 2.11 have the documented bytes in both directions."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.natnet import (
    BODY_TRACKED,
    MARKER_POINT_CLOUD_SOLVED,
    Body,
    BodyDescription,
    FrameOfData,
    LabeledMarker,
    MarkerSet,
    ModelDefinition,
    ServerInfo,
    decode,
    encode,
)
from jointfit_protocols.natnet._frame import Analog, Skeleton

VERSIONS = [(2, 5), (2, 6), (2, 7), (2, 8), (2, 9), (2, 10), (2, 11)]
BODY = Body(7, 0.5, 1.0, -0.25, 0.0, 0.0, 0.5, 0.75, 0.125, BODY_TRACKED)
FRAME = FrameOfData(
    1000,
    4.25,
    0,
    0,
    0,
    2,
    bodies=(BODY, BODY._replace(id=8)),
    markers=(LabeledMarker(65537, 1.0, 2.0, 3.0, 0.5, MARKER_POINT_CLOUD_SOLVED, 0.0),),
    marker_sets=(MarkerSet("Thigh", ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))),),
    other_markers=((4.0, 5.0, 6.0),),
    skeletons=(Skeleton(3, (BODY,)),),
    force_plates=(Analog(1, ((1.0, 2.0), (3.0,))),),
    devices=(Analog(2, ((4.0,),)),),
    timecode=5,
    subframe=6,
)


def fitting(version: tuple[int, int]) -> FrameOfData:
    """Return `FRAME` without the parts that bitstream `version` cannot contain."""
    frame = FRAME
    if version < (2, 11):
        frame = frame._replace(devices=())
    if version < (2, 9):
        frame = frame._replace(force_plates=())
    return frame if version >= (2, 6) else frame._replace(params=0)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_frame_is_decoded_as_it_was_encoded(version: tuple[int, int]) -> None:
    frame = fitting(version)
    assert decode(encode(frame, version), version) == frame


@pytest.mark.parametrize(
    ("version", "layout", "end"),
    [((2, 5), "<i", (0,)), ((2, 6), "<fhi", (2.0, 0, 0)), ((2, 7), "<dhi", (2.0, 0, 0))],
)
def test_the_end_of_a_frame_has_the_documented_fields(
    version: tuple[int, int], layout: str, end: tuple[float, ...]
) -> None:
    wire = encode(FrameOfData(9, 2.0, 0, 0, 0), version)
    # number, five empty sections, time stamp in place of the latency, timecode, sub-frame
    head = struct.pack("<i5ifII", 9, 0, 0, 0, 0, 0, 2.0, 0, 0)
    assert wire[4:] == head + struct.pack(layout, *end)


@pytest.mark.parametrize(
    ("version", "sections"), [((2, 8), 5), ((2, 9), 6), ((2, 10), 6), ((2, 11), 7)]
)
def test_force_plates_begin_with_2_9_and_devices_with_2_11(
    version: tuple[int, int], sections: int
) -> None:
    payload = struct.pack("<i", 9) + bytes(4 * sections)
    payload += struct.pack("<fIIdhi", 2.0, 0, 0, 2.0, 0, 0)
    wire = struct.pack("<HH", 7, len(payload)) + payload
    frame = FrameOfData(9, 2.0, 0, 0, 0)
    assert decode(wire, version) == frame
    assert encode(frame, version) == wire


def test_markers_inside_a_body_are_skipped() -> None:
    body = struct.pack("<i3f4fi", 7, 0.5, 1, -0.25, 0, 0, 0.5, 0.75, 2)
    inner = struct.pack("<6f2i2f", 1, 2, 3, 4, 5, 6, 11, 12, 0.1, 0.2)
    payload = struct.pack("<iiii", 1000, 0, 0, 1) + body + inner + struct.pack("<fh", 0.125, 1)
    payload += struct.pack("<iifIIdhi", 0, 0, 4.25, 0, 0, 4.25, 0, 0)
    found = decode(struct.pack("<HH", 7, len(payload)) + payload, (2, 8))
    assert isinstance(found, FrameOfData)
    assert found.bodies == (BODY,)


def test_before_2_6_a_body_at_the_origin_is_not_tracked() -> None:
    lost = Body(1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, BODY_TRACKED)
    found = decode(encode(FRAME._replace(bodies=(lost, BODY)), (2, 5)), (2, 5))
    assert isinstance(found, FrameOfData)
    assert [body.params for body in found.bodies] == [0, BODY_TRACKED]


@pytest.mark.parametrize("version", VERSIONS)
def test_descriptions_of_bodies_have_no_markers(version: tuple[int, int]) -> None:
    described = BodyDescription("Thigh", 7, -1, (0.5, 0.0, 0.25))
    model = ModelDefinition((described, BodyDescription("Shank", 8)))
    assert decode(encode(model, version), version) == model


def test_the_short_serverinfo_has_no_clock() -> None:
    info = ServerInfo("Motive", (1, 9, 0, 0), (2, 9, 0, 0), None)
    assert len(encode(info)) == 4 + 264
    assert decode(encode(info), (2, 9)) == info


@given(st.sampled_from(VERSIONS), st.data())
def test_damaged_frames_are_rejected_or_decoded_but_never_raise(
    version: tuple[int, int], data: st.DataObject
) -> None:
    wire = bytearray(encode(fitting(version), version))
    for _ in range(data.draw(st.integers(1, 4))):
        wire[data.draw(st.integers(4, len(wire) - 1))] = data.draw(st.integers(0, 255))
    assert isinstance(decode(bytes(wire), version), FrameOfData | CorruptBytes)
    assert isinstance(decode(bytes(wire[:-1]), version), CorruptBytes)
