"""The VRPN codec: byte vectors of the reference implementation, any split, hostile lengths."""

from __future__ import annotations

import itertools
import struct
import time
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols import vrpn
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.vrpn import (
    Announcement,
    Cookie,
    Disconnect,
    Ping,
    Pong,
    SenderDescription,
    TrackerMotion,
    TrackerPose,
    TypeDescription,
    UdpChannel,
    VrpnCodec,
    VrpnContent,
    VrpnMessage,
    decode_announcement,
    encode,
    encode_announcement,
    whole_messages,
)

COOKIE = bytes.fromhex("7672706e3a207665722e2030372e333820203000000000 00")
THIGH = bytes.fromhex(
    "00000022 6553f100 0003d090 00000001 ffffffff 00000001 00000006 546869676800 000000000000"
)
POSE = bytes.fromhex(
    "00000058 6553f100 0003d090 00000001 00000000 00000001 0000000000000000"
    "3fe0000000000000 3ff0000000000000 bfd0000000000000"
    "0000000000000000 0000000000000000 3fe3333333333333 3fe999999999999a"
)
TIME_US = 1_700_000_000_250_000
IDS = {name: number for number, name in enumerate(vrpn.TYPE_NAMES)}
DESCRIBED = b"".join(encode(TypeDescription(number, name)) for name, number in IDS.items())
SAMPLE = TrackerPose(TIME_US, 1, 0, 0.5, 1.0, -0.25, 0.0, 0.0, 0.6, 0.8)

numbers = st.floats(allow_nan=False)
ids = st.integers(0, 1999)
times = st.integers(0, 2**32 * 1_000_000 - 1)
names = st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=60)
contents = st.one_of(
    st.builds(Cookie, st.integers(0, 99), st.integers(0, 99), st.integers(0, 3)),
    st.builds(SenderDescription, ids, names),
    st.builds(UdpChannel, st.integers(1, 65535), names),
    st.just(Disconnect()),
    st.builds(TrackerPose, times, ids, ids, *(numbers,) * 7),
    st.builds(
        TrackerMotion, st.sampled_from([vrpn.VELOCITY, vrpn.ACCELERATION]), times, ids, ids,
        *(numbers,) * 8,
    ),
    st.builds(Ping, times, ids),
    st.builds(Pong, times, ids),
    st.builds(VrpnMessage, times, ids, st.integers(100, 1999), st.binary(max_size=100)),
)  # fmt: skip


def decoded(*pieces: bytes) -> list[VrpnContent | CorruptBytes]:
    codec = VrpnCodec()
    return [item for piece in pieces for item in codec.feed(piece)] + list(codec.flush())


def on_the_wire(messages: list[VrpnContent]) -> bytes:
    """Return the messages after the descriptions that they need, also after a cookie."""
    parts = [DESCRIBED]
    for message in messages:
        parts.append(encode(message, IDS))
        if isinstance(message, Cookie):
            parts.append(DESCRIBED)
    return b"".join(parts)


class TestVectors:
    def test_cookie(self) -> None:
        assert encode(Cookie()) == COOKIE
        assert decoded(COOKIE) == [Cookie(7, 38, 0)]

    def test_description_of_a_sender(self) -> None:
        assert decoded(THIGH) == [SenderDescription(1, "Thigh")]
        assert encode(SenderDescription(1, "Thigh"), sequence=1, time_us=TIME_US) == THIGH

    def test_pose(self) -> None:
        types = {vrpn.POS_QUAT: 0}
        assert decoded(encode(TypeDescription(0, vrpn.POS_QUAT)), POSE)[1:] == [SAMPLE]
        assert encode(SAMPLE, types, sequence=1) == POSE

    def test_announcement(self) -> None:
        assert encode_announcement(Announcement("10.0.0.2", 40000)) == b"10.0.0.2 40000\0"
        assert decode_announcement(b"10.0.0.2 40000\0") == Announcement("10.0.0.2", 40000)


@given(st.lists(contents, max_size=8))
def test_decoding_inverts_encoding(messages: list[VrpnContent]) -> None:
    found = [item for item in decoded(on_the_wire(messages)) if type(item) is not TypeDescription]
    assert found == messages


@given(st.lists(contents, max_size=5), st.lists(st.integers(0, 1000), max_size=10), st.binary())
def test_the_split_of_the_stream_does_not_matter(
    messages: list[VrpnContent], cuts: list[int], tail: bytes
) -> None:
    data = on_the_wire(messages) + tail
    places = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    pieces = [data[a:b] for a, b in itertools.pairwise(places)]
    whole = repr(decoded(data))
    assert repr(decoded(*pieces)) == whole
    assert repr(decoded(*(bytes((byte,)) for byte in data))) == whole


@given(st.binary(max_size=3000))
def test_every_byte_is_decoded_or_counted(data: bytes) -> None:
    codec = VrpnCodec()
    found = codec.feed(data) + list(codec.flush())
    lost = sum(item.discarded for item in found if isinstance(item, CorruptBytes))
    assert lost == codec.discarded <= len(data)
    assert codec.messages == sum(not isinstance(item, CorruptBytes) for item in found)


@pytest.mark.parametrize("length", [0, 23, vrpn.MAX_MESSAGE + 1, 2**31, 2**32 - 1])
def test_an_impossible_length_discards_until_the_next_connection(length: int) -> None:
    bad = struct.pack(">I", length) + POSE[4:]
    codec = VrpnCodec()
    found = codec.feed(DESCRIBED + bad + POSE)
    assert codec.lost
    assert not any(isinstance(item, TrackerPose) for item in found)

    again = codec.feed(COOKIE + DESCRIBED + POSE)
    assert isinstance(again[0], CorruptBytes)
    assert again[0].discarded == len(bad + POSE)
    assert again[1] == Cookie()
    assert again[-1] == SAMPLE


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (encode(SenderDescription(2000, "x")), "id outside"),
        (THIGH[:24] + b"\0\0\1\6" + THIGH[28:], "name longer"),
        (struct.pack(">IIIiiI", 24, 0, 0, 1, -1, 0), "without a name"),
        (DESCRIBED + struct.pack(">IIIiiI8x", 32, 0, 0, 1, 0, 0), "pose without"),
        (DESCRIBED + struct.pack(">IIIiiI8x", 32, 0, 0, 1, 1, 0), "72 bytes"),
        (DESCRIBED + struct.pack(">IIIiiI", 24, 0, 1_000_000, 1, 3, 0), "microseconds"),
    ],
)
def test_a_malformed_message_is_rejected_alone(data: bytes, reason: str) -> None:
    *_, corrupt, after = decoded(data, encode(SenderDescription(7, "after")))
    assert isinstance(corrupt, CorruptBytes)
    assert reason in corrupt.reason
    assert after == SenderDescription(7, "after")


def test_the_number_of_a_type_belongs_to_the_peer() -> None:
    types = {vrpn.POS_QUAT: 1234}
    described = encode(TypeDescription(1234, vrpn.POS_QUAT))
    assert decoded(encode(SAMPLE, types))[0] == VrpnMessage(TIME_US, 1, 1234, POSE[24:])
    assert decoded(described, encode(SAMPLE, types))[1] == SAMPLE


def test_a_cookie_may_end_with_memory_that_the_server_did_not_initialize() -> None:
    assert decoded(COOKIE[:20] + b"\x7f\x0a\xfe.", DESCRIBED)[0] == Cookie(7, 38, 0)


def test_a_cookie_forgets_the_peer_before() -> None:
    codec = VrpnCodec()
    codec.feed(COOKIE + DESCRIBED + THIGH)
    assert codec.senders == {1: "Thigh"}
    codec.feed(COOKIE)
    assert codec.senders == codec.types == {}


@pytest.mark.parametrize(
    "data", [b"", b"10.0.0.2", b"10.0.0.2 80\0", b"a_b 4000\0", b"x 65536\0", b"x 4000 1"]
)
def test_an_announcement_that_servers_refuse_is_rejected(data: bytes) -> None:
    assert isinstance(decode_announcement(data), CorruptBytes)


@given(st.lists(contents, max_size=5), st.integers(0, 400))
def test_whole_messages_end_between_messages(messages: list[VrpnContent], size: int) -> None:
    data = on_the_wire(messages)[:size]
    whole = whole_messages(data)
    assert not [item for item in decoded(data[:whole]) if isinstance(item, CorruptBytes)]
    rest = decoded(data[whole:])
    assert [type(item) for item in rest] == [CorruptBytes] * bool(data[whole:])


def test_pending_bytes_are_bounded_and_their_cost_is_linear() -> None:
    """A message of the longest length, in single bytes, costs no copy of its beginning."""
    head = struct.pack(">I", vrpn.MAX_MESSAGE)
    pieces = [bytes((byte,)) for byte in head + bytes(vrpn.MAX_MESSAGE)]
    codec = VrpnCodec()
    tracemalloc.start()
    began = time.process_time()
    for piece in pieces:
        codec.feed(piece)
        assert codec.pending <= vrpn.MAX_MESSAGE
    took = time.process_time() - began
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 * vrpn.MAX_MESSAGE
    assert took < 2.0
