"""The VRPN codec agrees with bytes of the reference implementation, however a stream is split.

Messages with an impossible length or malformed content are rejected.
"""

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
    is_whole,
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
    """Return the bytes of `messages`.

    Descriptions of senders and types precede the first message, and are repeated after each cookie.
    A cookie is the greeting of a new connection.
    """
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
        (DESCRIBED + struct.pack(">IIIiiI8x", 32, 0, 0, 1, 0, 0), "does not have 64 bytes"),
        (DESCRIBED + struct.pack(">IIIiiI8x", 32, 0, 0, 1, 1, 0), "72 bytes"),
        (DESCRIBED + struct.pack(">IIIiiI", 24, 0, 1_000_000, 1, 3, 0), "microseconds"),
    ],
)
def test_a_malformed_message_is_rejected_alone(data: bytes, reason: str) -> None:
    *_, corrupt, after = decoded(data, encode(SenderDescription(7, "after")))
    assert isinstance(corrupt, CorruptBytes)
    assert reason in corrupt.reason
    assert after == SenderDescription(7, "after")


def test_a_message_has_at_most_64_000_bytes() -> None:
    longest = VrpnMessage(0, 1, 5, bytes(64_000 - 24))
    assert decoded(encode(longest)) == [longest]
    with pytest.raises(ValueError, match="64001 bytes"):
        encode(longest._replace(body=bytes(64_000 - 23)))


@pytest.mark.parametrize(
    ("message", "accepted"),
    [
        (SenderDescription(1999, "x"), True),
        (SenderDescription(0, "x"), True),
        (SenderDescription(-1, "x"), False),
        (TypeDescription(1, "n" * 255), True),
        (TypeDescription(1, "n" * 256), False),
        (UdpChannel(0xFFFF, "h"), True),
        (UdpChannel(0x1_0000, "h"), False),
        (UdpChannel(0, "h"), False),
        (VrpnMessage(999_999, 1, 7, b""), True),
    ],
)
def test_values_at_their_limits_are_accepted(message: VrpnContent, accepted: bool) -> None:
    (found,) = decoded(encode(message))
    assert (found == message) is accepted


@pytest.mark.parametrize(
    ("datagram", "found"),
    [
        (b"x 1024", Announcement("x", 1024)),
        (b"x 65535\0", Announcement("x", 65_535)),
        (b"h" * 255 + b" 4000", Announcement("h" * 255, 4000)),
        (b"x 1023", CorruptBytes(6, "port outside 1024..65535")),
        (b"h" * 256 + b" 4000", CorruptBytes(261, "no announcement of a client")),
    ],
)
def test_announcements_at_their_limits(datagram: bytes, found: Announcement | CorruptBytes) -> None:
    assert decode_announcement(datagram) == found


def test_a_datagram_consists_of_whole_messages_or_is_rejected() -> None:
    longest = encode(VrpnMessage(0, 1, 5, bytes(64_000 - 24)))
    for datagram in (POSE, THIGH, POSE + THIGH, encode(VrpnMessage(0, 1, 5, b"")), longest):
        assert is_whole(datagram)
        assert not is_whole(datagram[:-1])
        assert not is_whole(datagram + b"\0")
        assert whole_messages(datagram) == len(datagram)
    assert not is_whole(b"")
    assert not is_whole(COOKIE)
    assert not is_whole(struct.pack(">I", 23) + bytes(20))
    assert not is_whole(struct.pack(">I", 64_001) + bytes(64_020))


def test_defaults_are_those_of_the_reference_implementation() -> None:
    assert encode(Cookie()) == COOKIE
    assert (vrpn.DEFAULT_PORT, vrpn.MAJOR) == (3883, 7)
    header = struct.unpack_from(">IIIiiI", encode(Ping(0, 2), IDS))
    assert header == (24, 0, 0, 2, IDS[vrpn.PING], 0)
    late = encode(Disconnect(), sequence=2**32 + 3, time_us=1_000_002)
    assert struct.unpack_from(">IIIiiI", late) == (24, 1, 2, 0, -5, 3)


def test_lost_bytes_are_reported_in_bounded_runs() -> None:
    codec = VrpnCodec()
    found = codec.feed(bytes(200_000))
    assert codec.pending == len("vrpn: ver.")  # these bytes may be the beginning of a cookie
    found += codec.flush()
    sizes = [item.discarded for item in found if isinstance(item, CorruptBytes)]
    assert sum(sizes) == codec.discarded == 200_000
    assert len(set(sizes[:-1])) == 1
    assert max(sizes) == sizes[0]


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
    """If the longest message is fed in single bytes, its beginning is not copied for each byte."""
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
