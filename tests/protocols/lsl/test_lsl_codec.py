"""The LSL codec: an independent XDF reader reads its chunks, and malformed chunks are counted."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.lsl import (
    FORMATS,
    MOST_CHANNELS,
    Channel,
    LslCodec,
    RoundTrip,
    Samples,
    StreamDescription,
    encode_description,
    encode_round_trip,
    encode_samples,
)

if TYPE_CHECKING:
    from pathlib import Path

CHANNEL = (
    "<channel><label>T1_X</label><marker>T1</marker><type>PositionX</type>"
    "<unit>meters</unit></channel>"
)


def xml(count: int = 3, kind: str = "double64", channels: str = "") -> str:
    return (
        f"<?xml version='1.0'?><info><name>Cameras</name><type>MoCap</type><channel_count>{count}"
        f"</channel_count><nominal_srate>100</nominal_srate><channel_format>{kind}</channel_format>"
        f"<source_id>s1</source_id><desc><channels>{channels}</channels></desc></info>"
    )


def described(count: int = 3, kind: str = "double64") -> LslCodec:
    codec = LslCodec()
    (found,) = codec.feed(encode_description(xml(count, kind)))
    assert isinstance(found, StreamDescription)
    return codec


def test_a_description_has_stream_and_channels() -> None:
    (found,) = LslCodec().feed(encode_description(xml(1, channels=CHANNEL)))
    assert isinstance(found, StreamDescription)
    assert (found.name, found.type, found.rate_hz, found.source_id) == (
        "Cameras",
        "MoCap",
        100.0,
        "s1",
    )
    assert found.channels == (Channel("T1_X", "T1", "", "PositionX", "meters"),)


@given(st.data(), st.sampled_from(["double64", "float32", "int32"]), st.integers(1, 9))
def test_samples_are_read_as_written(data: st.DataObject, kind: str, count: int) -> None:
    values = {
        "double64": st.floats(),
        "float32": st.floats(width=32),
        "int32": st.integers(-(2**31), 2**31 - 1),
    }[kind]
    rows = data.draw(st.lists(st.tuples(*(values,) * count), min_size=1, max_size=5))
    stamps = data.draw(st.tuples(*(st.floats(allow_nan=False),) * len(rows)))
    (found,) = described(count, kind).feed(encode_samples(kind, stamps, rows))
    assert isinstance(found, Samples)
    assert found.stamps_s == stamps
    np.testing.assert_array_equal(found.values, rows)


@given(st.integers(-(2**63), 2**63 - 1), st.integers(-(2**63), 2**63 - 1), st.floats())
def test_round_trips_are_read_as_written(sent: int, received: int, remote_s: float) -> None:
    (found,) = LslCodec().feed(encode_round_trip(RoundTrip(sent, received, remote_s)))
    assert isinstance(found, RoundTrip)
    assert (found.sent_ns, found.received_ns) == (sent, received)
    assert struct.pack("<d", found.remote_s) == struct.pack("<d", remote_s)


def test_an_independent_reader_of_xdf_reads_the_chunks(tmp_path: Path) -> None:
    pyxdf = pytest.importorskip("pyxdf")
    rows = np.random.default_rng(3).normal(size=(50, 3))
    stamps = 100.0 + 0.01 * np.arange(50)
    header = b"<info><version>1.0</version></info>"
    content = b"XDF:" + bytes([1, len(header) + 2]) + struct.pack("<H", 1) + header
    content += encode_description(xml())
    for n in range(0, 50, 10):
        part = slice(n, n + 10)
        content += encode_samples("double64", stamps[part].tolist(), rows[part].tolist())
        content += encode_round_trip(RoundTrip(1, 2, 100.0))
    (tmp_path / "stream.xdf").write_bytes(content)

    (stream,), _ = pyxdf.load_xdf(
        tmp_path / "stream.xdf", synchronize_clocks=False, dejitter_timestamps=False
    )
    np.testing.assert_array_equal(stream["time_series"], rows)
    np.testing.assert_array_equal(stream["time_stamps"], stamps)


@given(st.binary(max_size=300))
def test_random_bytes_are_discarded_and_counted(noise: bytes) -> None:
    codec = described()
    found = codec.feed(noise)
    lost = sum(item.discarded for item in found if isinstance(item, CorruptBytes))
    assert codec.discarded == lost <= len(noise)


@pytest.mark.parametrize(
    "content",
    [
        struct.pack("<HI", 3, 1) + b"\x08" + struct.pack("<Q", 2**62),
        struct.pack("<HI", 3, 1) + b"\x04\xff\xff\xff\xff",
        struct.pack("<HI", 3, 1) + b"\x05\x01",
        struct.pack("<HI", 3, 7) + b"\x01\x00",
        struct.pack("<HI", 2, 1) + b"<info><channel_count>99999999</channel_count></info>",
        struct.pack("<HI", 2, 1) + b"<!DOCTYPE a [<!ENTITY b 'c'>]><info>&b;</info>",
        struct.pack("<HI", 2, 1) + b"<info>" * 1000,
    ],
)
def test_hostile_counts_are_rejected(content: bytes) -> None:
    data = b"\x04" + struct.pack("<I", len(content)) + content
    (found,) = described().feed(data)
    assert isinstance(found, CorruptBytes)
    assert found.discarded == len(data)


def test_a_chunk_longer_than_its_datagram_is_rejected() -> None:
    (found,) = described().feed(b"\x08" + struct.pack("<Q", 2**63) + b"\0" * 20)
    assert isinstance(found, CorruptBytes)


def test_samples_before_the_description_are_counted() -> None:
    codec = LslCodec()
    assert codec.feed(encode_samples("float32", [1.0], [[1.0]])) == []
    assert codec.undescribed == 1


def test_chunks_have_the_bytes_of_the_specification() -> None:
    assert encode_samples("int16", [1.0], [[5, -1]]).hex() == (
        "01" "15" "0300" "01000000" "01" "01" "08" "000000000000f03f" "0500" "ffff"
    )  # fmt: skip
    assert encode_round_trip(RoundTrip(1, 2, 1.0)).hex() == (
        "01" "1e" "464a" "01000000" "0100000000000000" "0200000000000000" "000000000000f03f"
    )  # fmt: skip
    assert encode_description("é").hex() == "0108020001000000c3a9"


@pytest.mark.parametrize(("samples", "head"), [(1, "01 01"), (255, "01 ff"), (256, "04 00010000")])
def test_a_length_has_the_fewest_bytes(samples: int, head: str) -> None:
    wire = encode_samples("int8", [0.0] * samples, [[1]] * samples)
    chunk_head = 1 + wire[0]
    assert wire[chunk_head + 6 :].startswith(bytes.fromhex(head))
    content = len(wire) - chunk_head
    assert int.from_bytes(wire[1:chunk_head], "little") == content
    assert wire[0] == (1 if content < 256 else 4)
    codec = described(1, "int8")
    (found,) = codec.feed(wire)
    assert isinstance(found, Samples)
    assert len(found.values) == samples
    assert codec.messages == samples + 1


def test_a_length_of_eight_bytes_is_read() -> None:
    content = (
        struct.pack("<HI", 3, 1) + b"\x08" + struct.pack("<Q", 1) + struct.pack("<Bdb", 8, 2, 3)
    )
    (found,) = described(1, "int8").feed(b"\x08" + struct.pack("<Q", len(content)) + content)
    assert found == Samples((2.0,), ((3,),))


@pytest.mark.parametrize("samples", [1, 2])
def test_samples_without_a_time_stamp_are_corrupt(samples: int) -> None:
    wire = bytearray(encode_samples("int8", [0.0] * samples, [[1]] * samples))
    wire[-10] = 0  # the byte that states the size of the last stamp
    (found,) = described(1, "int8").feed(bytes(wire))
    assert found == CorruptBytes(len(wire), "sample without a time stamp")


def test_messages_before_a_corrupt_chunk_remain_and_the_rest_is_discarded() -> None:
    codec = described(1, "int8")
    trip = RoundTrip(1, 2, 3.0)
    assert codec.feed(encode_round_trip(trip) + b"\x02abcdef") == [
        trip, CorruptBytes(7, "no XDF chunk"),
    ]  # fmt: skip
    assert (codec.messages, codec.discarded) == (2, 7)


def test_chunks_of_other_kinds_are_counted_and_skipped() -> None:
    codec = described(1, "int8")
    assert codec.feed(b"\x01\x06\x04\x00\x01\x00\x00\x00") == []
    assert (codec.messages, codec.discarded) == (2, 0)
    short = b"\x01\x07\x46\x4a\x01\x00\x00\x00\x00"
    assert codec.feed(short) == [CorruptBytes(9, "round trip of 1 bytes")]


@pytest.mark.parametrize(
    ("count", "reason"),
    [
        ("0", "0 channels, expected 1 to 20000"),
        (str(MOST_CHANNELS + 1), "20001 channels, expected 1 to 20000"),
        ("12345678", "description without a number of channels"),
        ("-1", "description without a number of channels"),
        ("", "description without a number of channels"),
    ],
)
def test_a_number_of_channels_out_of_range_is_rejected(count: str, reason: str) -> None:
    wire = encode_description(f"<info><channel_count>{count}</channel_count></info>")
    assert LslCodec().feed(wire) == [CorruptBytes(len(wire), reason)]


def test_the_largest_number_of_channels_is_accepted() -> None:
    wire = encode_description(f"<info><channel_count>{MOST_CHANNELS}</channel_count></info>")
    (found,) = LslCodec().feed(wire)
    assert isinstance(found, StreamDescription)
    assert found.channel_count == 20_000
    assert (found.rate_hz, found.compensated_lag_s, found.channels) == (0.0, 0.0, ())


@pytest.mark.parametrize(
    ("rate", "lag", "expected"),
    [
        ("1e6", "10", (1e6, 10.0)),
        ("1000001", "10.1", (0.0, 0.0)),
        ("-1", "-1", (0.0, 0.0)),
        ("fast", "nan", (0.0, 0.0)),
    ],
)
def test_numbers_out_of_range_are_unknown(
    rate: str, lag: str, expected: tuple[float, float]
) -> None:
    wire = encode_description(
        f"<info><channel_count>1</channel_count><nominal_srate>{rate}</nominal_srate><desc>"
        f"<acquisition><compensated_lag>{lag}</compensated_lag></acquisition></desc></info>"
    )
    (found,) = LslCodec().feed(wire)
    assert isinstance(found, StreamDescription)
    assert (found.rate_hz, found.compensated_lag_s) == expected


def test_an_overlong_description_is_rejected() -> None:
    head = b"<info><channel_count>1</channel_count></info>"
    longest = head + b" " * ((8 << 20) - len(head))
    for xml_text, accepted in ((longest, True), (longest + b" ", False)):
        (found,) = LslCodec().feed(encode_description(xml_text.decode()))
        assert isinstance(found, StreamDescription) is accepted


def test_every_format_of_numbers_has_a_size() -> None:
    assert {name: struct.calcsize(f"<{code}") for name, code in FORMATS.items()} == {
        "float32": 4, "double64": 8, "int8": 1, "int16": 2, "int32": 4, "int64": 8,
    }  # fmt: skip
