"""QTM packets have the published bytes, survive a round trip, and malformed ones are refused."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols import qtm
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.qtm import ComponentType

VERSION = bytes.fromhex("15000000 01000000 56657273696f6e20312e323500")
FRAME = bytes.fromhex(
    "a8000000 03000000 40420f0000000000 65000000 02000000"
    "78000000 0b000000 02000000 03000000"
    "0000c842 00004843 00009643 00000000 0000803f 00000000 000080bf"
    + "00" * 16
    + "0000803f 0000003f"
    + "ff" * 48
    + "000080bf 18000000 11000000 01000000 02000000 01000000 02000000"
)
"""Frame with camera time: body 0 is at (100, 200, 300) mm, rotated by +90° about z; body 1 is
missing."""
FLOATS = st.floats(width=32, allow_nan=False)
U32 = st.integers(0, 2**32 - 1)


def test_a_command_is_text_with_a_nul() -> None:
    assert qtm.encode(qtm.Command("Version 1.25")) == VERSION
    assert qtm.decode(VERSION) == qtm.Command("Version 1.25")
    assert qtm.decode(b"\x14\0\0\0\x01\0\0\0Version 1.25") == qtm.Command("Version 1.25")


def test_the_published_frame_is_read_and_written_to_the_bit() -> None:
    frame = qtm.decode(FRAME)
    assert isinstance(frame, qtm.DataFrame)
    assert (frame.timestamp_us, frame.number) == (1_000_000, 101)
    (bodies,) = [part for part in frame.components if isinstance(part, qtm.ItemsComponent)]
    (timecode,) = [part for part in frame.components if isinstance(part, qtm.TimecodeComponent)]
    assert bodies[:3] == (ComponentType.BODIES_RESIDUAL, 3, 0)
    assert list(bodies.items[0]) == [100, 200, 300, 0, 1, 0, -1, 0, 0, 0, 0, 1, 0.5]
    assert all(map(math.isnan, bodies.items[1][:12]))
    assert timecode.timecodes[0].camera_ticks == 0x1_0000_0002
    assert qtm.encode(frame) == FRAME


def test_events_have_the_numbers_of_the_vendors_document() -> None:
    assert qtm.decode(bytes.fromhex("09000000 06000000 05")) == qtm.Event(5)
    assert {event.value: event.name for event in qtm.QtmEvent} == {
        1: "CONNECTED", 2: "CONNECTION_CLOSED", 3: "CAPTURE_STARTED", 4: "CAPTURE_STOPPED",
        5: "FETCHING_FINISHED", 6: "CALIBRATION_STARTED", 7: "CALIBRATION_STOPPED",
        8: "RT_FROM_FILE_STARTED", 9: "RT_FROM_FILE_STOPPED", 10: "WAITING_FOR_TRIGGER",
        11: "CAMERA_SETTINGS_CHANGED", 12: "SHUTTING_DOWN", 13: "CAPTURE_SAVED",
        14: "REPROCESSING_STARTED", 15: "REPROCESSING_STOPPED", 16: "TRIGGER",
    }  # fmt: skip


def test_discovery_and_its_answer_carry_big_endian_ports() -> None:
    assert qtm.encode(qtm.Discover(0x1234)) == bytes.fromhex("0a000000 07000000 1234")
    assert qtm.decode(bytes.fromhex("0a000000 07000000 1234")) == qtm.Discover(0x1234)
    answer = qtm.ServerAnnouncement("lab, QTM 2.5 (build 568), 5 cameras", 22222)
    assert qtm.decode_announcement(qtm.encode_announcement(answer)) == answer
    assert isinstance(qtm.decode_announcement(VERSION[:9]), CorruptBytes)


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (qtm.QtmTimecode(0, 0, 13 | 37 << 5 | 59 << 11 | 24 << 17), "13:37:59:24"),
        (qtm.QtmTimecode(0, 0, 13 | 37 << 5 | 59 << 11 | 24 << 17 | 80 << 22), "13:37:59:24.80"),
        (qtm.QtmTimecode(1, 26 | 327 << 7, 13 | 37 << 5 | 59 << 11 | 4 << 17), "26-327 13:37:59.4"),
        (qtm.QtmTimecode(0, 0, 0x7FFF_FFFF), "31:63:63:31.511"),
        (qtm.QtmTimecode(1, 0xFFFF, 0x001F_FFFF), "127-511 31:63:63.15"),
        (qtm.QtmTimecode(2, 1, 2), None),
        (qtm.QtmTimecode(9, 1, 2), None),
    ],
)
def test_timecodes_have_a_text_unless_they_are_camera_time(
    code: qtm.QtmTimecode, text: str | None
) -> None:
    assert code.text == text
    assert (code.camera_ticks is None) == (code.type != 2)


COMPONENTS = st.one_of(
    st.sampled_from(sorted(qtm.ITEM_LAYOUTS)).flatmap(
        lambda kind: st.builds(
            qtm.ItemsComponent,
            st.just(kind),
            st.integers(-(2**15), 2**15 - 1),
            st.integers(-(2**15), 2**15 - 1),
            st.lists(item_of(kind), max_size=3).map(tuple),
        )
    ),
    st.lists(st.builds(qtm.QtmTimecode, U32, U32, U32), max_size=3).map(
        lambda codes: qtm.TimecodeComponent(tuple(codes))
    ),
    st.lists(
        st.lists(st.builds(qtm.SkeletonSegment, U32, *[FLOATS] * 7), max_size=3).map(tuple),
        max_size=3,
    ).map(lambda skeletons: qtm.SkeletonComponent(tuple(skeletons))),
    st.builds(qtm.OpaqueComponent, st.sampled_from([3, 4, 7, 13, 16, 99]), st.binary(max_size=40)),
)


def item_of(kind: int) -> st.SearchStrategy[tuple[float, ...]]:
    layout = qtm.ITEM_LAYOUTS[kind]
    letters = layout.format.lstrip("<")
    parts: list[Any] = [FLOATS] * (layout.size // 4)
    if "I" in letters:
        parts[3] = U32
    return st.tuples(*parts)


MESSAGES = st.one_of(
    st.builds(qtm.Command, st.text("abc 1.?", max_size=30)),
    st.builds(qtm.ErrorReply, st.text("abc 1.?", max_size=30)),
    st.builds(qtm.SettingsReply, st.text("<a/>", max_size=30)),
    st.builds(qtm.Event, st.integers(0, 255)),
    st.just(qtm.NoMoreData()),
    st.builds(qtm.Discover, st.integers(0, 65535)),
    st.builds(qtm.SkippedPacket, st.sampled_from([5, 8, 77]), st.binary(max_size=30)),
    st.builds(
        qtm.DataFrame,
        st.integers(-(2**63), 2**63 - 1),
        U32,
        st.lists(COMPONENTS, max_size=4).map(tuple),
    ),
)


@given(MESSAGES)
def test_every_message_survives_a_round_trip(message: qtm.Message) -> None:
    assert qtm.decode(qtm.encode(message)) == message


@given(st.lists(MESSAGES, max_size=5), st.integers(1, 40))
def test_packets_do_not_depend_on_the_segments(messages: list[qtm.Message], size: int) -> None:
    data = b"".join(map(qtm.encode, messages))
    stream = qtm.QtmStream()
    found = [
        packet for at in range(0, len(data), size) for packet in stream.feed(data[at : at + size])
    ]
    assert [qtm.decode(p) for p in found if isinstance(p, bytes)] == messages
    assert stream.flush() == []


@given(st.binary(max_size=300))
def test_random_bytes_never_raise_and_are_counted(data: bytes) -> None:
    found = qtm.decode(data)
    if isinstance(found, CorruptBytes):
        assert found.discarded == len(data)
    qtm.decode_announcement(data)
    stream = qtm.QtmStream()
    parts = [*stream.feed(data), *stream.flush()]
    assert sum(p.discarded if isinstance(p, CorruptBytes) else len(p) for p in parts) == len(data)


@pytest.mark.parametrize("size", [0, 7, qtm.LARGEST_PACKET + 1, 2**32 - 1])
def test_after_an_impossible_size_the_stream_is_broken(size: int) -> None:
    stream = qtm.QtmStream()
    found = stream.feed(VERSION + struct.pack("<II", size, 1))
    assert found[0] == VERSION
    assert isinstance(found[1], CorruptBytes)
    assert stream.broken
    (rest,) = stream.feed(VERSION)
    assert isinstance(rest, CorruptBytes)


@pytest.mark.parametrize("at", [0, 20, 24, 32])
@pytest.mark.parametrize("value", [0, 7, 2**31, 2**32 - 1])
def test_hostile_counts_and_sizes_are_refused(at: int, value: int) -> None:
    changed = bytearray(FRAME)
    struct.pack_into("<I", changed, at, value)
    assert isinstance(qtm.decode(bytes(changed)), CorruptBytes)


def test_a_skeleton_with_a_hostile_count_is_refused() -> None:
    good = qtm.DataFrame(0, 1, (qtm.SkeletonComponent((((qtm.SkeletonSegment(1, *[0.0] * 7)),),)),))
    data = bytearray(qtm.encode(good))
    for at in (32, 36):
        changed = data.copy()
        struct.pack_into("<I", changed, at, 2**31)
        assert isinstance(qtm.decode(bytes(changed)), CorruptBytes)


def test_a_packet_has_8_bytes_to_16_megabytes_and_a_type_of_one_byte() -> None:
    sizes = {7: True, 8: False, 16 << 20: False, (16 << 20) + 1: True}
    for size, broken in sizes.items():
        stream = qtm.QtmStream()
        stream.feed(struct.pack("<II", size, 0))
        assert stream.broken is broken
    for kind, broken in ((0xFF, False), (0x100, True)):
        stream = qtm.QtmStream()
        stream.feed(struct.pack("<II", 100, kind))
        assert stream.broken is broken
