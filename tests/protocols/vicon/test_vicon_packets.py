"""Vicon packets have the published bytes, survive a round trip, and malformed ones are refused."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols import vicon
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.vicon import ObjectId

REQUEST = bytes.fromhex("01002b1a 09000000 a2860100 01000000 01")
PING = bytes.fromhex("01002b1a 10000000 2a000000 08000000 0100000000000000")
ZERO, ONE, MINUS_ONE = "00" * 8, "00" * 6 + "f03f", "00" * 6 + "f0bf"
FRAME = bytes.fromhex(
    "01002b1a 80000000 05000000 04000000 29000000 09000000 6c000000 01000000 01000000 01000000"
    "0000000000005940 0000000000006940 0000000000c07240"
    + ZERO + MINUS_ONE + ZERO + ONE + ZERO + ZERO + ZERO + ZERO + ONE
)  # fmt: skip
"""Frame 41. Segment 1 of subject 1 is at (100, 200, 300) mm, rotated by +90° about z."""

U32 = st.integers(0, 2**32 - 1)
F64 = st.floats(allow_nan=False)
F32 = st.floats(width=32, allow_nan=False)
NAME = st.text("abcÄ_ 1", max_size=12)


def several(strategy: st.SearchStrategy[Any]) -> st.SearchStrategy[tuple[Any, ...]]:
    return st.lists(strategy, max_size=3).map(tuple)


SEGMENT_POSES = several(
    st.builds(vicon.SegmentPose, U32, st.tuples(F64, F64, F64), st.tuples(*[F64] * 9))
)
OBJECTS = st.one_of(
    st.builds(vicon.StreamInfo, st.integers(-(2**63), 2**63 - 1)),
    st.builds(
        vicon.SubjectInfo, U32, NAME, several(st.builds(vicon.SegmentInfo, U32, U32, NAME)),
        several(st.builds(vicon.MarkerInfo, U32, NAME)), several(st.tuples(U32, U32)),
    ),
    st.builds(vicon.FrameInfo, U32),
    st.builds(vicon.LabeledRecons, several(st.builds(vicon.LabeledRecon, U32, U32, *[F64] * 4))),
    st.builds(vicon.Segments, st.sampled_from([8, 9]), U32, SEGMENT_POSES),
    st.builds(vicon.LightSegments, U32, several(st.builds(vicon.LightSegment, U32, *[F32] * 6))),
    st.builds(
        vicon.StreamTimecode, *[st.integers(0, 255)] * 4, *[st.integers(0, 65535)] * 2, U32, U32,
        st.integers(0, 255),
    ),
    st.builds(vicon.LatencyInfo, several(st.tuples(NAME, F64))),
    st.builds(vicon.HardwareFrame, U32),
    st.builds(vicon.ApplicationInfo, st.integers(-128, 127)),
    st.builds(vicon.FrameRates, several(st.tuples(NAME, F64))),
    st.builds(vicon.ObjectQuality, U32, F64),
    st.builds(vicon.ViconPing, st.integers(0, 2**64 - 1)),
    st.builds(vicon.ObjectEnums, st.frozensets(U32, max_size=4)),
    st.builds(vicon.RequestFrame, st.booleans()),
    st.just(vicon.KeepAlive()),
    st.builds(vicon.Contents, several(st.tuples(U32, U32)), st.frozensets(U32, max_size=4)),
    st.builds(vicon.OpaqueObject, st.sampled_from([7, 28, 29, 100_008]), st.binary(max_size=20)),
)  # fmt: skip
PACKETS = several(OBJECTS)


def test_the_published_bytes_are_read_and_written() -> None:
    assert vicon.encode(vicon.RequestFrame(True)) == REQUEST
    assert vicon.encode(vicon.ViconPing(1)) == PING
    pose = vicon.SegmentPose(1, (100, 200, 300), (0, -1, 0, 1, 0, 0, 0, 0, 1))
    objects = vicon.FrameInfo(41), vicon.Segments(ObjectId.GLOBAL_SEGMENTS, 1, (pose,))
    assert vicon.encode(*objects) == FRAME
    assert vicon.decode(FRAME) == vicon.Packet(objects)


@given(PACKETS)
def test_every_object_survives_a_round_trip(objects: tuple[vicon.Object, ...]) -> None:
    assert vicon.decode(vicon.encode(*objects)) == vicon.Packet(objects)


@given(st.lists(PACKETS, max_size=4), st.integers(1, 50))
def test_packets_do_not_depend_on_the_segments(
    packets: list[tuple[vicon.Object, ...]], size: int
) -> None:
    data = b"".join(vicon.encode(*objects) for objects in packets)
    stream = vicon.ViconStream()
    found = [
        packet for at in range(0, len(data), size) for packet in stream.feed(data[at : at + size])
    ]
    read = [vicon.decode(packet) for packet in found if isinstance(packet, bytes)]
    assert read == [vicon.Packet(objects) for objects in packets]


@given(st.binary(max_size=300))
def test_random_bytes_never_raise_and_are_counted(data: bytes) -> None:
    found = vicon.decode(data)
    if isinstance(found, CorruptBytes):
        assert found.discarded == len(data)
    stream = vicon.ViconStream()
    parts = [*stream.feed(data), *stream.flush()]
    assert sum(p.discarded if isinstance(p, CorruptBytes) else len(p) for p in parts) == len(data)


@given(st.sampled_from(sorted(ObjectId)), st.binary(max_size=200))
def test_random_bodies_never_raise(kind: int, body: bytes) -> None:
    vicon.decode(vicon.encode(vicon.OpaqueObject(kind, body)))


@pytest.mark.parametrize("kind", sorted(set(ObjectId) - {ObjectId.KEEP_ALIVE} - vicon.OPTIONAL))
def test_a_body_that_is_too_short_is_corrupt(kind: int) -> None:
    assert isinstance(vicon.decode(vicon.encode(vicon.OpaqueObject(kind, b""))), CorruptBytes)


@pytest.mark.parametrize("kind", sorted(vicon.OPTIONAL))
def test_an_optional_object_of_another_server_version_leaves_the_others_readable(kind: int) -> None:
    short = vicon.OpaqueObject(kind, b"\1")
    frame = vicon.FrameInfo(7)
    decoded = vicon.decode(vicon.encode(short, frame))
    known = kind == ObjectId.APPLICATION_INFO  # its layout is one byte
    assert decoded == vicon.Packet((vicon.ApplicationInfo(1) if known else short, frame))


def test_a_subject_without_attachments_or_markers_is_read() -> None:
    subject = vicon.SubjectInfo(1, "Leg", (vicon.SegmentInfo(0, 1, "Thigh"),), (), ())
    body = struct.pack("<II3sI2I24xI5s", 1, 3, b"Leg", 1, 0, 1, 5, b"Thigh")
    assert vicon.decode(vicon.encode(vicon.OpaqueObject(ObjectId.SUBJECT_INFO, body))) == (
        vicon.Packet((subject,))
    )


def test_fields_that_newer_servers_append_are_ignored() -> None:
    body = struct.pack("<I", 7) + b"more"
    packet = vicon.encode(vicon.OpaqueObject(ObjectId.FRAME_INFO, body))
    assert vicon.decode(packet) == vicon.Packet((vicon.FrameInfo(7),))


@pytest.mark.parametrize("value", [2**31, 2**32 - 1])
@pytest.mark.parametrize("at", [4, 12, 24, 32])
def test_hostile_counts_and_lengths_are_refused(at: int, value: int) -> None:
    changed = bytearray(FRAME)
    struct.pack_into("<I", changed, at, value)
    assert isinstance(vicon.decode(bytes(changed)), CorruptBytes)


@pytest.mark.parametrize("header", [(1, 0), (0x1A2B0001, vicon.LARGEST_PACKET + 1)])
def test_after_another_block_the_stream_is_broken(header: tuple[int, int]) -> None:
    stream = vicon.ViconStream()
    found = stream.feed(PING + struct.pack("<II", *header))
    assert found[0] == PING
    assert isinstance(found[1], CorruptBytes)
    assert stream.broken


def test_ids_are_those_of_the_protocol() -> None:
    assert [each.value for each in ObjectId] == [
        1, 2, 5, 6, 8, 9, 23, 26, 36, 37, 39, 40, 42, 901,
        100_001, 100_002, 100_003, 100_004,
    ]  # fmt: skip
    assert sorted(vicon.STATIC) == [1, 2, 28, 29, 37, 40, 28_001]
    assert sorted(vicon.DYNAMIC) == [5, 6, 7, 8, 9, 23, 26, 36, 39, 901]
    assert sorted(vicon.REQUESTS) == [100_005, 100_006, 100_007, 100_008]
    assert not vicon.STATIC & vicon.DYNAMIC


def test_a_packet_has_at_most_16_megabytes() -> None:
    for size, broken in ((16 << 20, False), ((16 << 20) + 1, True)):
        stream = vicon.ViconStream()
        stream.feed(struct.pack("<II", 0x1A2B0001, size))
        assert stream.broken is broken
    assert vicon.TICKS_PER_S == 135_000_000
