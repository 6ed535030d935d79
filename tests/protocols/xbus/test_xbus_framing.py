"""The Xbus codec counts every byte of any stream, however the stream is split into chunks."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from jointfit_protocols import xbus
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.xbus import MAX_MESSAGE, XbusCodec, XbusMessage, encode

if TYPE_CHECKING:
    from collections.abc import Callable

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data" / "imu"
VECTORS: list[dict[str, Any]] = (
    [
        entry
        for entry in json.loads((SHARED / "vectors.json").read_text(encoding="utf-8"))
        if entry["protocol"] == "xsens-xbus"
    ]
    if SHARED.is_dir()
    else []
)

messages = st.builds(encode, st.integers(0, 255), st.binary(max_size=300), st.integers(0, 255))
false_heads = st.sampled_from([b"\xfa", b"\xfa\xff", bytes.fromhex("faff36ff07d0"), b"\xfa\xfa"])
wires = st.lists(messages | st.binary(max_size=30) | false_heads, max_size=8).map(b"".join)


def decode(chunks: list[bytes]) -> tuple[list[XbusMessage | CorruptBytes], XbusCodec]:
    decoder = XbusCodec()
    found = [event for chunk in chunks for event in decoder.feed(chunk)]
    return found + decoder.flush(), decoder


def cut(wire: bytes, cuts: list[int]) -> list[bytes]:
    at = sorted({0, len(wire), *(place % (len(wire) + 1) for place in cuts)})
    return [wire[a:b] for a, b in itertools.pairwise(at)]


@given(wires, st.lists(st.integers(0, 5000), max_size=10))
def test_chunk_boundaries_do_not_change_the_messages(wire: bytes, cuts: list[int]) -> None:
    whole, _ = decode([wire])
    assert decode(cut(wire, cuts))[0] == whole
    assert decode([bytes([byte]) for byte in wire])[0] == whole


@given(st.lists(st.binary(min_size=1, max_size=6000), max_size=3), st.binary(max_size=5000))
@example([bytes(2050) + b"\xfa\xff\x36\x00\x99", bytes(4000)], b"")
@example([bytes(2054) + b"\xfa\xff\x36\xff\xff\xff", bytes(4000)], b"")
@example([b"\xfa\xff\x36\x00\x99" + bytes(2000), bytes(4000)], b"")
def test_long_noise_is_reported_in_bounded_runs_whatever_the_cut(
    noise: list[bytes], tail: bytes
) -> None:
    whole, _ = decode([b"".join(noise) + tail])
    assert decode([*noise, tail])[0] == whole
    assert decode([bytes([byte]) for byte in b"".join(noise) + tail])[0] == whole
    assert all(event.discarded <= MAX_MESSAGE for event in whole if isinstance(event, CorruptBytes))


@given(wires)
def test_every_byte_is_in_a_message_or_counted(wire: bytes) -> None:
    found, decoder = decode([wire])
    used = sum(event.size for event in found if isinstance(event, XbusMessage))
    lost = sum(event.discarded for event in found if isinstance(event, CorruptBytes))
    assert used + lost == len(wire)
    assert lost == decoder.discarded
    assert decoder.messages == sum(isinstance(event, XbusMessage) for event in found)


@given(st.lists(st.binary(max_size=3000), max_size=5))
def test_pending_bytes_are_bounded(chunks: list[bytes]) -> None:
    decoder = XbusCodec()
    for chunk in chunks:
        decoder.feed(chunk)
        assert decoder.pending < MAX_MESSAGE


@pytest.mark.parametrize(
    ("wire", "reason"),
    [
        (b"abc", "no message starts here"),
        (b"abc\xfa\xff\x36\x00\x99", "checksum"),
        (b"\xfa\xff\x36\xff\xff\xff", "length outside 255..2048"),
        (b"\xfa\xff\x36\x20abc", "cut off"),
    ],
)
def test_a_run_is_named_for_its_first_real_fault(wire: bytes, reason: str) -> None:
    """A run of corrupt bytes is reported once. Bytes that begin no message are no real fault."""
    assert decode([wire])[0] == [CorruptBytes(len(wire), reason)]


@pytest.mark.parametrize("length", [0, 254, 2049, 65535])
def test_a_length_no_message_has_is_not_waited_for(length: int) -> None:
    decoder, good = XbusCodec(), encode(0x36, b"good")
    found = decoder.feed(b"\xfa\xff\x36\xff" + length.to_bytes(2, "big") + good)
    assert [event.data for event in found if isinstance(event, XbusMessage)] == [b"good"]


@given(st.integers(0, 255), st.binary(max_size=2048), st.integers(0, 255))
def test_encoded_xbus_message_decodes_to_itself(mid: int, data: bytes, bid: int) -> None:
    wire = encode(mid, data, bid)
    assert decode([wire])[0] == [XbusMessage(mid, data, bid, len(wire))]


@given(messages, st.integers(0, 10_000), st.integers(0, 7))
def test_no_single_flipped_bit_passes(wire: bytes, place: int, bit: int) -> None:
    bad = bytearray(wire)
    bad[place % len(wire)] ^= 1 << bit
    found, _ = decode([bytes(bad)])
    assert all(not isinstance(event, XbusMessage) or event.size < len(wire) for event in found)


def test_a_message_inside_a_broken_one_is_found() -> None:
    good = encode(0x36, b"inside")
    found, decoder = decode([b"\xfa\xff\x36\x20" + good + bytes(40)])
    assert [event.data for event in found if isinstance(event, XbusMessage)] == [b"inside"]
    assert decoder.discarded == 44


def test_message_end_is_its_offset_in_the_stream() -> None:
    wire = b"\x00\x01" + encode(0x31) + encode(0x36, b"abc")
    ends = [event.end for event in decode([wire])[0] if isinstance(event, XbusMessage)]
    assert ends == [7, 15]


def test_more_data_than_a_message_holds_is_a_bug_of_the_caller() -> None:
    with pytest.raises(ValueError, match="2048"):
        encode(0x36, bytes(2049))


def test_every_message_id_has_its_own_number_and_a_reply_follows_its_request() -> None:
    ids = {item.name: item.value for item in xbus.XbusMessageId}
    for name, value in ids.items():
        if name.endswith("_ACK") and name != "WAKE_UP_ACK":
            assert ids[name.removesuffix("_ACK")] + 1 == value
        if name.startswith("REQ_"):
            assert ids[name.removeprefix("REQ_")] == value + 1


@pytest.mark.skipif(not VECTORS, reason="vectors.json is not here")
@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["id"])
def test_vector(vector: dict[str, Any]) -> None:
    wire = bytes.fromhex(vector["hex"])
    found, decoder = decode([wire])
    if not vector["valid"]:
        assert decoder.messages == 0
        assert decoder.discarded == len(wire)
        return
    (message,) = found
    assert isinstance(message, XbusMessage)
    assert encode(message.mid, message.data, message.bid) == wire


def test_there_are_33_vectors(shared_data: Path) -> None:
    assert len(VECTORS) == 33


def frame_starts(wire: bytes) -> list[int]:
    found, _ = decode([wire])
    return [event.end - event.size for event in found if isinstance(event, XbusMessage)]


def insert(wire: bytes, index: int, what: bytes) -> bytes:
    at = frame_starts(wire)[index]
    return wire[:at] + what + wire[at:]


def replace(wire: bytes, at: int, byte: int) -> bytes:
    return wire[:at] + bytes([byte]) + wire[at + 1 :]


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "first 10 removed": lambda wire: wire[10:],
    "last 20 removed": lambda wire: wire[:-20],
    "bit flipped in frame 1": lambda wire: replace(wire, 93, wire[93] ^ 1),
    "FA before frame 50": lambda wire: insert(wire, 50, b"\xfa"),
    "false 2000-byte head before frame 50": lambda wire: insert(
        wire, 50, bytes.fromhex("faff36ff07d0")
    ),
    "LEN of frame 10 is FE": lambda wire: replace(wire, frame_starts(wire)[10] + 3, 0xFE),
    "start inside frame 36": lambda wire: wire[frame_starts(wire)[37] - 137 :],
    "start inside frame 48": lambda wire: wire[frame_starts(wire)[49] - 45 :],
}


@pytest.mark.parametrize("number", ["1", "3", "5"])
def test_a_recording_decodes_whole(shared_data: Path, number: str) -> None:
    wire = (shared_data / "imu" / "xsens" / f"{number}.output.bin").read_bytes()
    found, decoder = decode([wire])
    assert (decoder.messages, decoder.discarded, decoder.checksum_failures) == (100, 0, 0)
    assert {(event.mid, event.bid) for event in found if isinstance(event, XbusMessage)} == {
        (0x36, 0xFF)
    }


@pytest.mark.parametrize(
    ("number", "case", "expected"),
    [
        ("5", "first 10 removed", (99, 43, 0)),
        ("5", "last 20 removed", (99, 143, 0)),
        ("5", "bit flipped in frame 1", (99, 75, 1)),
        ("5", "FA before frame 50", (100, 1, 1)),
        ("5", "false 2000-byte head before frame 50", (100, 6, 1)),
        ("5", "LEN of frame 10 is FE", (99, 141, 1)),
        ("1", "start inside frame 36", (63, 137, 1)),
        ("1", "start inside frame 48", (51, 45, 1)),
    ],
)
@pytest.mark.parametrize("size", [1, 7, 64, 100_000])
def test_damaged_recording_loses_damaged_messages_only(
    shared_data: Path, number: str, case: str, expected: tuple[int, int, int], size: int
) -> None:
    whole = (shared_data / "imu" / "xsens" / f"{number}.output.bin").read_bytes()
    wire = DAMAGE[case](whole)
    _, decoder = decode([wire[at : at + size] for at in range(0, len(wire), size)])
    assert (decoder.messages, decoder.discarded, decoder.checksum_failures) == expected
