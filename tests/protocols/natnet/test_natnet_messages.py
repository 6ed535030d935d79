"""The NatNet codec: messages survive a round trip, and malformed datagrams become corrupt bytes."""

from __future__ import annotations

import struct
from typing import Any, TypeVar

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.natnet import (
    AssetDescription,
    Bare,
    Body,
    BodyDescription,
    CommandRequest,
    CommandResponse,
    Connect,
    Discovery,
    EchoRequest,
    EchoResponse,
    FrameOfData,
    LabeledMarker,
    MarkerSet,
    MarkerSetDescription,
    Message,
    ModelDefinition,
    NatNetMessageId,
    ServerInfo,
    SkeletonDescription,
    decode,
    encode,
)
from jointfit_protocols.natnet._cursor import Cursor, MalformedError
from jointfit_protocols.natnet._frame import Analog, Asset, Skeleton, read_analogs
from jointfit_protocols.natnet._messages import MessageString
from jointfit_protocols.natnet._model import (
    AssetMarkerDescription,
    CameraDescription,
    DeviceDescription,
    PlateDescription,
    UnknownDescription,
)

T = TypeVar("T")

VERSIONS = [(3, 0), (3, 1), (4, 0), (4, 1), (4, 2)]
versions = st.sampled_from(VERSIONS)

f32 = st.floats(width=32, allow_nan=False)
i32 = st.integers(-(2**31), 2**31 - 1)
i16 = st.integers(-(2**15), 2**15 - 1)
u32 = st.integers(0, 2**32 - 1)
u64 = st.integers(0, 2**64 - 1)
u8x4 = st.tuples(*[st.integers(0, 255)] * 4)
names = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20)
xyz = st.tuples(f32, f32, f32)
groups = st.ip_addresses(v=4).map(str)
plates = st.tuples(f32, i32).map(lambda pair: (pair[0],) * 161 + (pair[1],) * 2)


def tuples(of: st.SearchStrategy[T], size: int = 3) -> st.SearchStrategy[tuple[T, ...]]:
    return st.lists(of, max_size=size).map(tuple)


bodies = st.builds(Body, i32, *[f32] * 8, i16)
markers = st.builds(LabeledMarker, i32, *[f32] * 4, i16, f32)
analogs = st.builds(Analog, i32, tuples(tuples(f32)))


@st.composite
def frames(draw: st.DrawFn) -> tuple[FrameOfData, tuple[int, int]]:
    version = draw(versions)
    precision = st.tuples(u32, u32)
    frame = FrameOfData(
        draw(i32), draw(st.floats(allow_nan=False)), draw(u64), draw(u64), draw(u64), draw(i16),
        bodies=draw(tuples(bodies)),
        markers=draw(tuples(markers)),
        marker_sets=draw(tuples(st.builds(MarkerSet, names, tuples(xyz)))),
        other_markers=draw(tuples(xyz)),
        skeletons=draw(tuples(st.builds(Skeleton, i32, tuples(bodies)))),
        assets=draw(tuples(st.builds(Asset, i32, tuples(bodies), tuples(markers))))
        if version >= (4, 1)
        else (),
        force_plates=draw(tuples(analogs)),
        devices=draw(tuples(analogs)),
        timecode=draw(u32),
        subframe=draw(u32),
        precision=draw(precision if version >= (4, 1) else precision | st.none()),
    )  # fmt: skip
    return frame, version


@st.composite
def body_descriptions(draw: st.DrawFn, version: tuple[int, int]) -> BodyDescription:
    n = draw(st.integers(0, 3))

    def some(of: st.SearchStrategy[T]) -> tuple[T, ...]:
        return tuple(draw(st.lists(of, min_size=n, max_size=n)))

    return BodyDescription(
        draw(names),
        draw(i32),
        draw(i32),
        draw(xyz),
        some(xyz),
        some(i32),
        some(names) if version >= (4, 0) else (),
    )


@st.composite
def models(draw: st.DrawFn) -> tuple[ModelDefinition, tuple[int, int]]:
    version = draw(versions)
    body = body_descriptions(version)
    kinds: list[st.SearchStrategy[Any]] = [
        st.builds(MarkerSetDescription, names, tuples(names)),
        body,
        st.builds(SkeletonDescription, names, i32, tuples(body)),
        st.builds(PlateDescription, i32, names, plates, tuples(names)),
        st.builds(DeviceDescription, i32, names, names, i32, i32, tuples(names)),
        st.builds(CameraDescription, names, xyz, st.tuples(*[f32] * 4)),
    ]
    if version >= (4, 1):
        marker = st.builds(AssetMarkerDescription, names, i32, xyz, f32, i16)
        kinds += [
            st.builds(AssetDescription, names, i32, i32, tuples(body), tuples(marker)),
            st.builds(UnknownDescription, st.integers(7, 99), st.binary(max_size=9)),
        ]
    return ModelDefinition(draw(tuples(st.one_of(kinds)))), version


plain = st.one_of(
    st.builds(Connect, st.just(264), names, u8x4, u8x4, st.just(False), st.just((0, 0, 0, 0))),
    st.builds(Connect, st.sampled_from([269, 271]), names, u8x4, u8x4, st.booleans(), u8x4),
    st.just(Connect(0)),
    st.just(Discovery(Connect(5, "Ping"))),
    st.builds(ServerInfo, names, u8x4, u8x4, u64, st.integers(0, 65535), st.booleans(), groups),
    st.just(ServerInfo("old", (1, 9, 0, 0), (2, 9, 0, 0), None)),
    st.builds(CommandRequest, names),
    st.builds(CommandResponse, st.binary(max_size=12)),
    st.builds(MessageString, names),
    st.builds(EchoRequest, u64),
    st.builds(EchoResponse, u64, u64),
    st.sampled_from([Bare(NatNetMessageId.KEEPALIVE), Bare(NatNetMessageId.REQUEST_MODELDEF)]),
)
messages = st.one_of(frames(), models(), plain.map(lambda message: (message, (3, 0))))


@settings(max_examples=50)
@given(messages)
def test_encoded_natnet_message_decodes_to_itself(case: tuple[Message, tuple[int, int]]) -> None:
    message, version = case
    assert decode(encode(message, version), version) == message


@given(st.binary(max_size=400), versions)
def test_any_bytes_give_a_message_or_corrupt(data: bytes, version: tuple[int, int]) -> None:
    decode(data, version)


@given(st.sampled_from([1, 5, 7, 14]), st.binary(max_size=400), versions)
def test_any_payload_gives_a_message_or_corrupt(
    number: int, payload: bytes, version: tuple[int, int]
) -> None:
    decode(struct.pack("<HH", number, len(payload)) + payload, version)


@settings(max_examples=50)
@given(messages, st.data(), versions)
def test_damaged_message_is_counted_as_corrupt_completely(
    case: tuple[Message, tuple[int, int]], data: st.DataObject, read_as: tuple[int, int]
) -> None:
    wire = bytearray(encode(*case))
    for _ in range(data.draw(st.integers(1, 4))):
        wire[data.draw(st.integers(0, len(wire) - 1))] = data.draw(st.integers(0, 255))
    found = decode(bytes(wire), read_as)
    assert not isinstance(found, CorruptBytes) or found.discarded == len(wire)


@settings(max_examples=50)
@given(messages, st.data())
def test_a_cut_datagram_is_corrupt_as_a_whole(
    case: tuple[Message, tuple[int, int]], data: st.DataObject
) -> None:
    wire = encode(*case)
    cut = wire[: data.draw(st.integers(0, len(wire) - 1))]
    found = decode(cut, case[1])
    assert isinstance(found, CorruptBytes)
    assert found.discarded == len(cut)


@settings(max_examples=50)
@given(frames(), st.integers(1, 30))
def test_bytes_left_over_make_a_frame_corrupt(
    case: tuple[FrameOfData, tuple[int, int]], more: int
) -> None:
    wire = bytearray(encode(*case)) + bytes(more)
    struct.pack_into("<H", wire, 2, len(wire) - 4)
    found = decode(bytes(wire), case[1])
    if isinstance(found, FrameOfData):  # 8 additional zeros can be a precision timestamp
        assert case[0].precision is None or found.skipped
    else:
        assert isinstance(found, CorruptBytes)


@pytest.mark.parametrize("place", [8, 12, 16, 20, 24])
@pytest.mark.parametrize("count", [-1, 2**31 - 1, 100_000])
def test_a_hostile_count_is_corrupt(place: int, count: int) -> None:
    wire = bytearray(encode(FrameOfData(1, 0.0, 1, 2, 3)))
    struct.pack_into("<i", wire, place, count)
    assert isinstance(decode(bytes(wire), (3, 0)), CorruptBytes)


@pytest.mark.parametrize("count", [-1, 3, 2**31 - 1])
def test_count_beyond_the_remaining_bytes_is_rejected(count: int) -> None:
    with pytest.raises(MalformedError):
        Cursor(struct.pack("<iii", count, 0, 0)).count(4)


def test_a_count_of_channels_that_leaves_a_channel_without_its_size_is_rejected() -> None:
    # the id, the number of channels (4), and the sizes of only 3 channels
    with pytest.raises(MalformedError, match="a count exceeds the datagram"):
        read_analogs(Cursor(struct.pack("<iiiii", 1, 4, 0, 0, 0)), 1)
    found = read_analogs(Cursor(struct.pack("<iiiiii", 1, 4, 0, 0, 0, 0)), 1)
    assert found == (Analog(1, ((), (), (), ())),)


def test_a_name_of_255_bytes_is_accepted_and_a_longer_one_is_refused() -> None:
    longest = "é" * 127 + "n"  # 127 letters of 2 bytes and one of 1 byte
    model = ModelDefinition((MarkerSetDescription(longest, ()),))
    assert decode(encode(model), (3, 0)) == model
    with pytest.raises(ValueError, match="at most 255 bytes"):
        encode(ModelDefinition((MarkerSetDescription(longest + "n", ()),)))
    with pytest.raises(MalformedError, match="a name without an end"):
        Cursor(b"n" * 256 + b"\0").text()


def test_a_bitstream_before_2_5_is_refused_by_name() -> None:
    found = decode(encode(FrameOfData(1, 0.0, 1, 2, 3)), (2, 4))
    assert isinstance(found, CorruptBytes)
    assert "2.4" in found.reason


def test_from_4_1_a_malformed_section_is_skipped_by_its_size() -> None:
    marker = LabeledMarker(65537, 1.0, 2.0, 3.0, 0.5, 10, 0.0)
    wire = bytearray(
        encode(
            FrameOfData(
                7,
                0.0,
                1,
                2,
                3,
                bodies=(Body(1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1),),
                markers=(marker,),
            ),
            (4, 1),
        )
    )
    at = 4 + 4 + 8 + 8
    assert struct.unpack_from("<ii", wire, at) == (1, 38)
    struct.pack_into("<i", wire, at, 2)
    found = decode(bytes(wire), (4, 1))
    assert isinstance(found, FrameOfData)
    assert (found.bodies, found.markers, found.skipped) == ((), (marker,), ("bodies",))


def test_a_section_that_a_later_bitstream_added_is_skipped() -> None:
    wire = encode(FrameOfData(7, 0.0, 1, 2, 3), (4, 1))
    new = struct.pack("<ii", 1, 12) + bytes(range(12))
    # The stamps are followed by 14 bytes: precision timestamp, flags and end tag.
    tail = struct.calcsize("<IIdQQQ") + 14
    grown = wire[4:-tail] + new + wire[-tail:]
    found = decode(struct.pack("<HH", 7, len(grown)) + grown, (4, 3))
    assert isinstance(found, FrameOfData)
    assert (found.number, found.transmit, found.skipped) == (7, 3, ("unknown",))


def test_unknown_description_below_4_1_ends_the_model_with_a_note() -> None:
    known = MarkerSetDescription("a", ("b",))
    wire = encode(ModelDefinition((known, known)))
    second = wire.rindex(b"\0\0\0\0a")
    broken = wire[:second] + struct.pack("<i", 77) + wire[second + 4 :]
    assert decode(broken, (3, 0)) == ModelDefinition((known,), complete=False)


@pytest.mark.parametrize("rotation", [None, (0.0, 0.0, 0.0, 1.0)])
def test_the_offset_quaternion_of_4_2_is_found_by_the_size(
    rotation: tuple[float, float, float, float] | None,
) -> None:
    body = BodyDescription(
        "Thigh", 3, -1, (0.0, 0.0, 0.0), ((1.0, 2.0, 3.0),), (0,), ("T1",), rotation
    )
    model = ModelDefinition((body, SkeletonDescription("S", 1, (body,))))
    assert decode(encode(model, (4, 2)), (4, 2)) == model


def test_the_captured_echo_is_read_and_written() -> None:
    request = bytes.fromhex("0c000800 4e669a1000000000")
    response = bytes.fromhex("0d001000 4e669a1000000000 0485e4cd49010000")
    assert decode(request, (3, 0)) == EchoRequest(278554190)
    assert decode(response, (3, 0)) == EchoResponse(278554190, 1416498545924)
    assert encode(EchoResponse(278554190, 1416498545924)) == response


FRAME_4_1 = (
    "0700a000e8030000" + "00" * 16 + "0100000026000000070000000000003f0000803f000080be"
    + "00" * 8 + "9a99193fcdcc4c3f17b751390100" + "00" * 40
    + "00" * 8 + "abaaaaaaaaaa104000e40b5402000000b0970c5402000000f0b60c5402000000"
    + "00" * 8 + "000000000000"
)  # fmt: skip


def test_the_4_1_vector_of_an_independent_client_is_read_and_written() -> None:
    wire = bytes.fromhex(FRAME_4_1)
    assert len(wire) == 164
    found = decode(wire, (4, 1))
    assert isinstance(found, FrameOfData)
    (body,) = found.bodies
    assert (found.number, found.exposure, found.precision) == (1000, 10_000_000_000, (0, 0))
    assert (body.id, body.x, body.y, body.z, body.params) == (7, 0.5, 1.0, -0.25, 1)
    assert (body.qz, body.qw, body.error) == pytest.approx((0.6, 0.8, 0.0002), abs=1e-7)
    assert encode(found, (4, 1)) == wire
