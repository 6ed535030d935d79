"""The x-IMU3 codec counts every byte of any stream, however the stream is split into chunks."""

from __future__ import annotations

import itertools
import json
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.ximu3 import (
    MAX_LINE,
    DataKind,
    XImu3Codec,
    XImu3Data,
    XImu3Reply,
    encode_command,
    encode_data,
    encode_multiplexed,
    encode_text,
)
from jointfit_protocols.ximu3._messages import COUNTS

if TYPE_CHECKING:
    from collections.abc import Sequence

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data" / "imu"
VECTORS: list[dict[str, Any]] = (
    [
        entry
        for entry in json.loads((SHARED / "vectors.json").read_text(encoding="utf-8"))
        if entry["protocol"] == "ximu3"
    ]
    if SHARED.is_dir()
    else []
)
NUMERIC = sorted((kind, count) for kind, counts in COUNTS.items() for count in counts)
TEXTS = sorted(set(DataKind) - set(COUNTS))

times = st.integers(0, 2**64 - 1)
floats = st.floats(width=32, allow_nan=False, allow_infinity=False)
numeric = st.sampled_from(NUMERIC).flatmap(
    lambda kind: st.builds(
        encode_data, st.just(kind[0]), times, st.lists(floats, min_size=kind[1], max_size=kind[1]),
        binary=st.booleans(),
    )
)  # fmt: skip
texts = st.builds(encode_text, st.sampled_from(TEXTS), times, st.binary(max_size=40))
values: st.SearchStrategy[Any] = st.none() | st.booleans() | st.integers() | st.text(max_size=20)
commands = st.builds(encode_command, st.text(max_size=20), values)
messages = numeric | texts | commands
pieces = messages | st.binary(max_size=40) | messages.map(lambda wire: wire[:-1])
wires = st.lists(pieces, max_size=8).map(b"".join)


def decode(chunks: Sequence[bytes]) -> tuple[list[Any], XImu3Codec]:
    codec = XImu3Codec()
    found = [event for chunk in chunks for event in codec.feed(chunk)]
    return found + codec.flush(), codec


def cut(wire: bytes, cuts: list[int]) -> list[bytes]:
    at = sorted({0, len(wire), *(place % (len(wire) + 1) for place in cuts)})
    return [wire[a:b] for a, b in itertools.pairwise(at)]


@pytest.mark.skipif(not VECTORS, reason="vectors.json is not here")
@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["id"])
def test_every_vector_is_decoded_or_refused(vector: dict[str, Any]) -> None:
    wire = bytes.fromhex(vector["hex"])
    found, codec = decode([wire])
    if not vector["valid"]:
        assert [type(event) for event in found] == [CorruptBytes]
        assert codec.discarded == len(wire)
        return

    (message,) = found
    expected = vector.get("decoded", {})
    assert message.size == message.end == len(wire)
    if isinstance(message, XImu3Data):
        assert message.ticks == expected["timestamp_us"]
        assert list(message.values) == expected.get("native_wxyz", [expected.get("edge")])
    else:
        assert isinstance(message, XImu3Reply)
        assert message.key == expected.get("key", message.key)
        assert (message.error is not None) == expected.get("error", False)
        if "sn" in expected:
            assert isinstance(message.value, dict)
            assert message.value["sn"] == expected["sn"]


@pytest.mark.parametrize("size", [1, 7, 1000, 100_000])
def test_the_recording_has_203_messages_and_no_corrupt_byte(shared_data: Path, size: int) -> None:
    wire = (shared_data / "imu" / "ximu3" / "synthetic_quaternion.ximu3").read_bytes()
    found, codec = decode([wire[at : at + size] for at in range(0, len(wire), size)])
    assert (codec.messages, codec.discarded, len(found)) == (203, 0, 203)
    assert [message.binary for message in found] == [False] + 202 * [True]
    assert {message.kind for message in found} == {DataKind.QUATERNION}
    assert [found[n].ticks for n in (0, -2, -1)] == [1_000_000, 2_990_001, 711_434]
    steps = [b.ticks - a.ticks for a, b in itertools.pairwise(found)]
    counts = {step: steps.count(step) for step in set(steps)}
    assert counts == {10_001: 133, 9_998: 66, 0: 2, -2_278_567: 1}


@given(wires, st.lists(st.integers(0, 5000), max_size=10))
def test_chunk_boundaries_do_not_change_the_messages(wire: bytes, cuts: list[int]) -> None:
    whole, _ = decode([wire])
    assert decode(cut(wire, cuts))[0] == whole
    assert decode([bytes([byte]) for byte in wire])[0] == whole


def changed(place: int, byte: int) -> bytes:
    """Return a message of the usual type with one changed byte."""
    usual = encode_data("Q", 1_000_000, (1.0, 0.0, 0.0, 0.0))
    return usual[:place] + bytes([byte]) + usual[place + 1 :]


@pytest.mark.parametrize(
    "other",
    [
        pytest.param(b"", id="none"),
        pytest.param(changed(0, 0xC9), id="another kind"),
        pytest.param(changed(12, 0x0A), id="a terminator inside"),
        pytest.param(changed(25, 0), id="no terminator"),
        pytest.param(changed(12, 0x0A)[:-1] + b"\0", id="an early terminator"),
        pytest.param(changed(12, 0xDB), id="malformed escape"),
        pytest.param(encode_data("Q", 0xDB0A, (1.0, 0.0, 0.0, 0.0)), id="escapes"),
        pytest.param(encode_data("I", 1_000_000, (0.5,) * 6), id="other layout"),
        pytest.param(encode_command("ping"), id="command"),
    ],
)
@pytest.mark.parametrize("before", [0, 1, 70, 140])
def test_a_run_of_messages_equals_single_ones_up_to_another_line(before: int, other: bytes) -> None:
    """Messages with the same layout are decoded together, with the result of single decoding."""
    values = (0.5, -0.5, 0.5, -0.5)
    run = [encode_data("Q", 1_000_000 + 3 * number, values) for number in range(before + 40)]
    lines = [*run[:before], other, *run[before:]]
    together, codec = decode([b"".join(lines)])
    alone, single = decode(lines)
    assert together == alone
    assert (codec.messages, codec.discarded) == (single.messages, single.discarded)
    assert together[-1].end == len(b"".join(lines))


@given(st.lists(st.sampled_from([4095, 4096, 4097, 4351, 4352, 4353, 9000]), max_size=3), messages)
@example([4352], encode_command("ping"))
def test_lines_without_end_are_reported_in_bounded_runs_whatever_the_cut(
    sizes: list[int], message: bytes
) -> None:
    wire = b"".join(bytes(size - 1) + b"\n" for size in sizes) + bytes(9000) + message
    whole, codec = decode([wire])
    assert decode(cut(wire, [1, 4096, 4352, 5000, 9000, 12_345]))[0] == whole
    lost = [event.discarded for event in whole if isinstance(event, CorruptBytes)]
    assert max(lost) <= MAX_LINE + 256
    assert codec.pending == 0


@given(wires)
def test_every_byte_is_in_a_message_or_counted(wire: bytes) -> None:
    found, codec = decode([wire])
    lost = sum(event.discarded for event in found if isinstance(event, CorruptBytes))
    used = sum(event.size for event in found if not isinstance(event, CorruptBytes))
    assert used + lost == len(wire) == codec.fed
    assert lost == codec.discarded


@given(st.lists(st.binary(max_size=6000), max_size=5))
def test_pending_bytes_are_bounded(chunks: list[bytes]) -> None:
    codec = XImu3Codec()
    for chunk in chunks:
        codec.feed(chunk)
        assert codec.pending < MAX_LINE + 256


@given(st.sampled_from(NUMERIC), times, st.data(), st.booleans())
def test_numbers_survive_a_round_trip(
    kind: tuple[DataKind, int], ticks: int, data: st.DataObject, binary: bool
) -> None:
    numbers = data.draw(st.lists(floats, min_size=kind[1], max_size=kind[1]))
    wire = encode_data(kind[0], ticks, numbers, binary=binary)
    ((message,), _) = decode([wire])
    assert (message.kind, message.ticks, message.binary) == (kind[0], ticks, binary)
    if binary:
        assert struct.pack(f"<{kind[1]}f", *message.values) == struct.pack(f"<{kind[1]}f", *numbers)
    else:
        assert list(message.values) == pytest.approx(numbers, abs=6e-5)
    assert wire.count(b"\n") == 1


@given(st.sampled_from(TEXTS), times, st.binary(max_size=60))
def test_text_survives_a_round_trip(kind: DataKind, ticks: int, text: bytes) -> None:
    ((message,), _) = decode([encode_text(kind, ticks, text)])
    assert (message.kind, message.ticks, message.text) == (kind, ticks, text)


@given(st.text(max_size=20), values | st.dictionaries(st.text(max_size=5), values, max_size=3))
def test_commands_survive_a_round_trip(key: str, value: Any) -> None:
    ((message,), _) = decode([encode_command(key, value)])
    assert (message.key, message.value) == (key, value)


@given(messages, messages)
def test_a_message_of_a_multiplexer_has_its_channel(one: bytes, other: bytes) -> None:
    found, _ = decode([one + encode_multiplexed(0x41, other)])
    plain, _ = decode([other])
    assert found[0].channel is None
    assert found[1] == plain[0]._replace(
        channel=0x41, size=len(other) + 2, end=len(one) + len(other) + 2
    )


small_times = st.integers(0, 2**52 - 1)
complete = commands | st.builds(
    encode_data, st.just("Q"), small_times, st.lists(floats, min_size=4, max_size=4),
    binary=st.booleans(),
)  # fmt: skip


@given(st.integers(9, 25), complete)
def test_a_message_after_one_that_lost_its_end_is_found(kept: int, message: bytes) -> None:
    truncated = encode_data("Q", 1, (1.0, 0.0, 0.0, 0.0))[:kept]
    found, _ = decode([truncated + message])
    (plain,), _ = decode([message])
    assume(isinstance(found[0], CorruptBytes))  # the joined parts may happen to be a valid message
    assert found[0].discarded == kept
    assert found[1:] == [plain._replace(end=kept + len(message))]


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"\n", "no known message"),
        (b"hello\r\n", "no known message"),
        (b"Q,1,2,3,4\r\n", "malformed ASCII message"),
        (b"Q,1,1,0,0,nan\r\n", "malformed ASCII message"),
        (b"Q,-1,1,0,0,0\r\n", "malformed ASCII message"),
        (b"Q,99999999999999999999,1,0,0,0\r\n", "malformed ASCII message"),
        (b"Q1,1,1,0,0,0\r\n", "malformed ASCII message"),
        (b"\xd1\x00\n", "binary message of another length"),
        (b"\xda\x01" + bytes(7) + b"\n", "no known message"),
        (b"\xda\x01" + bytes(11) + b"\n", "message of unknown kind Z with 1 values"),
        (b"\xd1\xdb\xdb\n", "escape byte without DC or DD after it"),
        (b"\xd1\xdb\n", "escape byte without DC or DD after it"),
        (b"{}\n", "JSON with other than one key, or malformed"),
        (b'{"a":1,"b":2}\n', "JSON with other than one key, or malformed"),
        (b'{"a":1,"a":2}\n', "JSON with other than one key, or malformed"),
        (b'{"a":NaN}\n', "JSON with other than one key, or malformed"),
        (b'{"a":' + b"[" * 2000 + b"\n", "JSON with other than one key, or malformed"),
        (b"^\n", "message of a multiplexer malformed"),
        (b"^A^B^C^D{}\n", "message of a multiplexer malformed"),
    ],
)
def test_a_malformed_line_is_named_for_its_fault(line: bytes, reason: str) -> None:
    assert decode([line])[0] == [CorruptBytes(len(line), reason)]


def test_bytes_after_the_last_line_are_cut_off() -> None:
    assert decode([encode_data("Q", 1, (1.0, 0.0, 0.0, 0.0))[:-1]])[0] == [
        CorruptBytes(25, "cut off")
    ]


def test_older_firmware_sends_a_quaternion_with_accelerations() -> None:
    numbers = (0.5, -0.5, 0.5, 0.5, 1.0, 2.0, 3.0)
    for kind in ("L", "E"):
        ((message,), _) = decode([encode_data(kind, 7, numbers)])
        assert message.values == numbers


def test_values_and_texts_of_another_kind_are_not_encoded() -> None:
    with pytest.raises(ValueError, match="3 values in a message of kind Q"):
        encode_data("Q", 1, (1.0, 2.0, 3.0))
    with pytest.raises(ValueError, match="kind Q has numbers"):
        encode_text("Q", 1, b"text")
