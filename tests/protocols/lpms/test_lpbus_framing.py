"""The LP-BUS codec decodes the test vectors and counts every byte, however a stream is split."""

from __future__ import annotations

import itertools
import json
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.lpms import MAX_DATA, MAX_MESSAGE, LpBusCodec, LpBusMessage, encode

if TYPE_CHECKING:
    from pathlib import Path

messages = st.builds(
    encode, st.integers(0, 255), st.binary(max_size=200), st.sampled_from([1, 2, 255])
)
false_heads = st.sampled_from(
    [
        b"\x3a",
        b"\x3a\x01\x00\x09\x00\x00\x04",
        b"\x3a\x01\x00\x09\x00\xff\xff",
        b"\x3a\x3a",
        b"\r\n",
    ]
)
wires = st.lists(messages | st.binary(max_size=30) | false_heads, max_size=8).map(b"".join)


def decode(chunks: list[bytes]) -> tuple[list[LpBusMessage | CorruptBytes], LpBusCodec]:
    decoder = LpBusCodec()
    found = [event for chunk in chunks for event in decoder.feed(chunk)]
    return found + decoder.flush(), decoder


def vectors(shared_data: Path) -> list[dict[str, Any]]:
    everything = json.loads((shared_data / "imu" / "vectors.json").read_text())
    return [each for each in everything if each["protocol"] == "lpms-lpbus"]


def test_the_twenty_vectors_are_messages_or_corrupt_as_marked(shared_data: Path) -> None:
    known = vectors(shared_data)
    assert len(known) == 20
    for vector in known:
        wire = bytes.fromhex(vector["hex"])
        found, decoder = decode([wire])
        if not vector["valid"]:
            assert [type(item) for item in found] == [CorruptBytes], vector["id"]
            assert decoder.discarded == len(wire)
            continue
        (message,) = found
        assert isinstance(message, LpBusMessage), vector["id"]
        assert (message.size, message.end) == (len(wire), len(wire))
        if vector["id"] != "lp-id-258-word-lrc":  # is accepted, but never sent
            assert encode(message.command, message.data, message.sensor_id) == wire
        for key in ("sensor_id", "command"):
            if key in vector.get("decoded", {}):
                assert getattr(message, key) == vector["decoded"][key]


@given(wires, st.lists(st.integers(0, 5000), max_size=10))
def test_chunk_boundaries_do_not_change_the_messages(wire: bytes, cuts: list[int]) -> None:
    whole, _ = decode([wire])
    at = sorted({0, len(wire), *(place % (len(wire) + 1) for place in cuts)})
    assert decode([wire[a:b] for a, b in itertools.pairwise(at)])[0] == whole
    assert decode([bytes([byte]) for byte in wire])[0] == whole


@given(wires)
def test_every_byte_is_in_a_message_or_counted(wire: bytes) -> None:
    found, decoder = decode([wire])
    used = sum(event.size for event in found if isinstance(event, LpBusMessage))
    lost = sum(event.discarded for event in found if isinstance(event, CorruptBytes))
    assert used + lost == len(wire)
    assert lost == decoder.discarded
    assert decoder.messages == sum(isinstance(event, LpBusMessage) for event in found)
    assert all(event.discarded <= MAX_MESSAGE for event in found if isinstance(event, CorruptBytes))


@given(st.lists(st.binary(max_size=3000), max_size=5))
def test_pending_bytes_are_bounded(chunks: list[bytes]) -> None:
    decoder = LpBusCodec()
    for chunk in chunks:
        decoder.feed(chunk)
        assert decoder.pending < MAX_MESSAGE


@pytest.mark.parametrize(
    ("wire", "reason"),
    [
        (b"abc", "no message starts here"),
        (b"abc" + encode(9, b"data")[:-4] + b"\x00\x00\r\n", "checksum"),
        (encode(9, b"data")[:-1] + b"\x00", "terminator is not CR LF"),
        (b"\x3a\x01\x00\x09\x00\x01\x04", "length above 1024"),
        (b"\x3a\x01\x00\x09\x00\x20\x00abc", "cut off"),
    ],
)
def test_a_run_has_the_reason_of_its_first_fault(wire: bytes, reason: str) -> None:
    """A run is a sequence of corrupt bytes. It is reported once, with one reason."""
    assert decode([wire])[0] == [CorruptBytes(len(wire), reason)]


@pytest.mark.parametrize("length", [MAX_DATA + 1, 65535])
def test_a_length_above_the_bound_is_not_waited_for(length: int) -> None:
    decoder, good = LpBusCodec(), encode(9, b"good")
    found = decoder.feed(b"\x3a\x01\x00\x09\x00" + length.to_bytes(2, "little") + good)
    assert [event.data for event in found if isinstance(event, LpBusMessage)] == [b"good"]


def test_a_message_inside_a_corrupt_one_is_found() -> None:
    inner = encode(9, b"inner")
    outer = bytearray(encode(9, inner + b"rest"))
    outer[-4] ^= 1
    found, decoder = decode([bytes(outer)])
    assert [event.data for event in found if isinstance(event, LpBusMessage)] == [b"inner"]
    assert decoder.checksum_failures == 1


@given(st.integers(0, 65535), st.binary(max_size=MAX_DATA), st.integers(0, 65535))
def test_an_encoded_message_decodes_to_itself(command: int, data: bytes, sensor_id: int) -> None:
    wire = encode(command, data, sensor_id)
    assert decode([wire])[0] == [LpBusMessage(sensor_id, command, data, len(wire))]


@given(st.integers(0, 65535), st.binary(max_size=600), st.integers(0, 65535))
def test_the_sum_of_words_is_accepted_too(command: int, data: bytes, sensor_id: int) -> None:
    wire = bytearray(encode(command, data, sensor_id))
    words = (sensor_id + command + len(data) + sum(data)) & 0xFFFF
    wire[-4:-2] = words.to_bytes(2, "little")
    assert decode([bytes(wire)])[0] == [LpBusMessage(sensor_id, command, data, len(wire))]


@given(messages, st.integers(0, 10_000), st.integers(0, 7))
def test_no_single_flipped_bit_passes(wire: bytes, place: int, bit: int) -> None:
    bad = bytearray(wire)
    bad[place % len(wire)] ^= 1 << bit
    found, _ = decode([bytes(bad)])
    assert all(not isinstance(event, LpBusMessage) or event.size < len(wire) for event in found)


def test_time_is_linear_in_bytes() -> None:
    """Every seventh byte of this stream could start a message of the greatest length."""
    decoder = LpBusCodec()
    hostile = b"\x3a\x3a\x00\x3a\x00\x00\x04" * 3000
    for at in range(0, len(hostile), 7):
        decoder.feed(hostile[at : at + 7])
    assert decoder.discarded + decoder.pending == len(hostile)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((9, bytes(1025)), "1025 bytes of data"),
        ((70_000,), "70000"),
        ((9, b"", -1), "sensor id -1"),
    ],
)
def test_a_message_that_cannot_be_sent_is_refused(arguments: tuple[Any, ...], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        encode(*arguments)


def test_a_message_holds_at_most_1024_bytes() -> None:
    longest = encode(9, bytes(1024))
    assert len(longest) == MAX_MESSAGE == 1035
    (message,) = LpBusCodec().feed(longest)
    assert message == LpBusMessage(1, 9, bytes(1024), 1035)
    assert isinstance(message, LpBusMessage)
    assert message.size == 1035
    with pytest.raises(ValueError, match="1025 bytes of data"):
        encode(9, bytes(1025))


def test_numbers_have_16_bits() -> None:
    (message,) = LpBusCodec().feed(encode(65_535, b"", 65_535))
    assert message == LpBusMessage(65_535, 65_535, b"", 11)
    for command, sensor_id in ((65_536, 1), (1, 65_536), (-1, 1)):
        with pytest.raises(ValueError, match="expected 0 to 65535 each"):
            encode(command, b"", sensor_id)
