"""The SHTP codec decodes escaped packets and counts every byte, however the stream is split.

The reports of the sensor hub are converted in both directions.
"""

from __future__ import annotations

import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.bno085 import (
    MOST_PAYLOAD,
    HubReport,
    HubReportId,
    ShtpBufferStatus,
    ShtpChannel,
    ShtpCodec,
    ShtpPacket,
    base_time,
    decode_firmware,
    decode_gyro_rotations,
    decode_interval,
    decode_report,
    encode_base_time,
    encode_feature,
    encode_firmware,
    encode_gyro_rotation,
    encode_report,
    encode_shtp,
    encode_status,
    feature_request,
    product_request,
    split_reports,
    unknown_report,
)
from jointfit_protocols.corrupt import CorruptBytes
from tests.protocols.bno085.adafruit_oracle import adafruit

Found = ShtpPacket | ShtpBufferStatus | CorruptBytes

payloads = st.binary(max_size=40) | st.lists(st.sampled_from([0x7D, 0x7E, 0x5D, 0x5E])).map(bytes)
packets = st.builds(encode_shtp, st.integers(0, 255), st.integers(0, 255), payloads)
pieces_of_wire = packets | st.binary(max_size=30) | st.integers(0, 65535).map(encode_status)
wires = st.lists(pieces_of_wire, max_size=8).map(b"".join)


def decode(pieces: list[bytes]) -> tuple[list[Found], ShtpCodec]:
    codec = ShtpCodec()
    found = [event for piece in pieces for event in codec.feed(piece)]
    return found + codec.flush(), codec


@given(wires, st.lists(st.integers(0, 400), max_size=6))
def test_packets_do_not_depend_on_the_cut_and_every_byte_is_counted(
    wire: bytes, cuts: list[int]
) -> None:
    whole, codec = decode([wire])
    at = sorted({0, len(wire), *(place % (len(wire) + 1) for place in cuts)})
    assert decode([wire[a:b] for a, b in itertools.pairwise(at)])[0] == whole
    assert decode([bytes([byte]) for byte in wire])[0] == whole
    between = sum(
        item.discarded if isinstance(item, CorruptBytes) else item.size - 2 for item in whole
    )
    assert between + codec.flags == len(wire)


@given(st.integers(0, 255), st.integers(0, 255), payloads)
def test_payloads_survive_their_escapes(channel: int, sequence: int, payload: bytes) -> None:
    wire = encode_shtp(channel, sequence, payload)
    assert wire.count(b"\x7e") == 2
    (packet,), _ = decode([wire])
    assert packet == ShtpPacket(channel, sequence, payload, len(wire), len(wire))


def test_documented_bytes() -> None:
    """Requests, escapes and the buffer status have the bytes in the documents of the vendor."""
    assert encode_shtp(2, 0, product_request()).hex() == "7e0106000200f9007e"
    assert encode_status(None).hex() == "7e007e"
    assert encode_shtp(2, 1, bytes((0x7E, 0x7D))).hex() == "7e01060002017d5e7d5d7e"
    found, _ = decode([bytes.fromhex("7e0000017e")])
    assert found == [ShtpBufferStatus(256, 5, 5)]
    feature = encode_feature(HubReportId.ROTATION_VECTOR, 10_000)
    assert feature.hex() == "fd0500000010270000" + "00" * 8


def test_adjacent_packets_may_share_a_flag() -> None:
    one, two = encode_shtp(3, 0, b"ab"), encode_shtp(3, 1, b"cd")
    found, _ = decode([one[:-1] + two])
    assert [item.payload for item in found if isinstance(item, ShtpPacket)] == [b"ab", b"cd"]


def test_a_packet_after_damage_is_found() -> None:
    good = encode_shtp(3, 1, b"cd")
    for bad in (b"\x01\x09", good[:4] + b"\x7e", b"\x7e\x01\x7d\x7e", b"\x7e\x05ab\x7e", good[1:]):
        found, _ = decode([bad + good])
        assert isinstance(found[-1], ShtpPacket), bad
        assert found[-1].payload == b"cd"


def test_a_silence_between_packets_costs_no_packet_and_one_inside_costs_its_rest() -> None:
    one, two = encode_shtp(3, 0, b"ab"), encode_shtp(3, 1, b"cd")
    codec = ShtpCodec()
    assert len(codec.feed(one)) == 1
    assert codec.flush() == []
    (found,) = codec.feed(two[1:])  # begins with the closing flag of the first packet
    assert isinstance(found, ShtpPacket)
    assert codec.feed(two[:4]) == []
    assert codec.flush() == [CorruptBytes(3, "cut off")]
    assert codec.feed(two[4:]) == [CorruptBytes(len(two) - 5, "no frame starts here")]


def test_a_wrong_length_is_corrupt() -> None:
    wire = bytearray(encode_shtp(3, 0, b"abcd"))
    wire[2] += 1
    (found,), codec = decode([bytes(wire)])
    assert found == CorruptBytes(9, "length")
    assert codec.messages == 0


def test_noise_without_flag_is_bounded() -> None:
    codec = ShtpCodec()
    found = codec.feed(b"\x7e" + bytes(50_000))
    assert codec.pending <= 2 * (MOST_PAYLOAD + 5)
    assert sum(item.discarded for item in found if isinstance(item, CorruptBytes)) > 40_000
    with pytest.raises(ValueError, match="2045 bytes"):
        encode_shtp(3, 0, bytes(2045))


@pytest.mark.parametrize("kind", [0x01, 0x02, 0x03, 0x05, 0x07, 0x08, 0x14, 0x15, 0x28, 0x29])
@given(st.data())
def test_reports_survive_both_directions(kind: int, data: st.DataObject) -> None:
    count = {0x05: 5, 0x28: 5, 0x07: 6, 0x08: 4, 0x29: 4}.get(kind, 3)
    raw = data.draw(st.lists(st.integers(-(2**15), 2**15 - 1), min_size=count, max_size=count))
    head = bytes((kind, data.draw(st.integers(0, 255)), data.draw(st.integers(0, 255)), 7))
    size = {0x05: 14, 0x28: 14, 0x08: 12, 0x29: 12, 0x07: 16, 0x14: 16, 0x15: 16}.get(kind, 10)
    wire = (head + struct.pack(f"<{count}h", *raw)).ljust(size, b"\0")
    (part,) = split_reports(wire) or [b""]
    report = decode_report(part)
    assert report is not None
    assert report.delay == (head[2] >> 2) << 8 | 7
    assert encode_report(report) == wire


def test_units_of_reports() -> None:
    report = decode_report(bytes.fromhex("0507030000000000666633330030"))
    assert report is not None
    assert (report.sequence, report.status, report.delay) == (7, 3, 0)
    assert report.values == pytest.approx((0.0, 0.0, 0x6666 / 16384, 0x3333 / 16384, 3.0))
    force = decode_report(bytes.fromhex("010002000000000" + "0d009"))
    assert force is not None
    assert force.values == pytest.approx((0.0, 0.0, 0x09D0 / 256))


@pytest.mark.parametrize(
    ("kind", "units"),
    [
        (0x01, (1 / 256,) * 3),
        (0x02, (1 / 512,) * 3),
        (0x03, (1 / 16,) * 3),
        (0x05, (1 / 16384,) * 4 + (1 / 4096,)),
        (0x07, (1 / 512,) * 6),
        (0x08, (1 / 16384,) * 4),
        (0x14, (1.0,) * 3),
        (0x15, (1.0,) * 3),
        (0x28, (1 / 16384,) * 4 + (1 / 4096,)),
        (0x29, (1 / 16384,) * 4),
    ],
)
def test_a_count_has_the_unit_of_the_manual(kind: int, units: tuple[float, ...]) -> None:
    counts = range(1, len(units) + 1)
    head = bytes((kind, 200, 0b1111_1101, 5))
    report = decode_report(head + struct.pack(f"<{len(units)}h", *counts))
    values = tuple(count * unit for count, unit in zip(counts, units, strict=True))
    assert report == HubReport(kind, 200, 1, (63 << 8) + 5, values)


def test_values_out_of_range_are_clipped_to_16_bits() -> None:
    far = HubReport(HubReportId.ACCELEROMETER, 256 + 7, 3, 1 << 14, (1e3, -1e3, 127.99609375))
    assert encode_report(far).hex() == "0107ffff" + "ff7f" + "0080" + "ff7f"
    assert decode_report(encode_report(far._replace(delay=(1 << 14) - 2))) == HubReport(
        1, 7, 3, (1 << 14) - 2, (32767 / 256, -128.0, 32767 / 256)
    )
    turn = encode_gyro_rotation((9.0, -9.0, 0.5, 1.0, 99.0, -99.0, 1.5))
    assert struct.unpack("<7h", turn) == (32767, -32768, 8192, 16384, 32767, -32768, 1536)


def test_gyro_rotations_fill_their_packet() -> None:
    one = (0.5, -0.25, 0.75, 0.125, 1.0, -2.0, 0.25)
    assert decode_gyro_rotations(2 * encode_gyro_rotation(one)) == [one, one]
    assert decode_gyro_rotations(encode_gyro_rotation(one)[:-1]) is None
    assert decode_gyro_rotations(b"") is None


LENGTHS = {
    2: (0xEF,),
    4: (0xF5,),
    5: (0x10, 0xFA, 0xFB),
    6: (0x0C, 0x0D, 0x0E, 0x12, 0x13, 0x19, 0x1A, 0x1C, 0x1F, 0x20, 0x21, 0x22, 0x23, 0x2B),
    8: (0x0A, 0x0B, 0x18, 0x1B),
    10: (0x01, 0x02, 0x03, 0x04, 0x06),
    12: (0x08, 0x11, 0x29, 0x2E),
    14: (0x05, 0x09, 0x28, 0x2A),
    16: (0x07, 0x0F, 0x14, 0x15, 0x16, 0x1E, 0xF1, 0xF3, 0xF8),
    17: (0xFC,),
    24: (0x2C,),
    60: (0x2D,),
}
"""Ids of the reports of each length, bytes, in the vendor's host library."""


def test_reports_have_the_lengths_of_the_vendors_library() -> None:
    known = {kind: size for size, kinds in LENGTHS.items() for kind in kinds}
    for kind in range(256):
        report = bytes((kind,)).ljust(known.get(kind, 1), b"\0")
        if kind in known:
            assert split_reports(report + encode_base_time(3)) == [report, encode_base_time(3)]
            assert unknown_report(report + report) is None
        else:
            assert split_reports(report) is None
            assert unknown_report(encode_base_time(3) + report) == kind


def test_ids_of_reports_are_those_of_the_manual() -> None:
    assert [kind.value for kind in HubReportId] == [
        0x01, 0x02, 0x03, 0x05, 0x07, 0x08, 0x14, 0x15, 0x28, 0x29, 0x2A,
        0xF8, 0xF9, 0xFA, 0xFB, 0xFC, 0xFD, 0xFE,
    ]  # fmt: skip


def test_channels_have_the_numbers_of_the_manual() -> None:
    assert {channel.value: channel.name for channel in ShtpChannel} == {
        0: "COMMAND", 1: "EXECUTABLE", 2: "CONTROL", 3: "INPUT", 4: "WAKE_INPUT",
        5: "GYRO_ROTATION",
    }  # fmt: skip


def test_base_times_have_the_sign_of_the_vendors_library() -> None:
    assert base_time(encode_base_time(120)) == -120
    assert base_time(bytes.fromhex("fa78000000")) == 120
    assert base_time(bytes.fromhex("f900")) is None


@pytest.mark.parametrize(("kind", "size"), [(0x2C, 24), (0x2D, 60), (0x2E, 12)])
def test_reports_of_the_bno086_are_skipped_by_their_length(kind: int, size: int) -> None:
    other, base = bytes((kind,)).ljust(size, b"\0"), encode_base_time(3)
    assert split_reports(base + other + base) == [base, other, base]


def test_packets_of_unknown_or_cut_off_reports_are_refused() -> None:
    assert split_reports(encode_base_time(3) + b"\x99") is None
    assert split_reports(encode_base_time(3)[:-1]) is None
    assert split_reports(b"") == []


def test_replies_of_the_hub() -> None:
    wire = encode_firmware((3, 12, 4), 10_004_148, 230)
    assert decode_firmware(wire) == ((3, 12, 4), 10_004_148, 230)
    assert decode_firmware(b"\xf8") is None
    assert decode_interval(encode_feature(5, 10_000, response=True)) == (5, 10_000)
    assert decode_interval(b"\xfc") is None
    assert decode_interval(encode_feature(5, 10_000)) == (5, 10_000)
    assert decode_interval(b"\xf8" + bytes(16)) is None
    assert decode_firmware(b"\xf9" + bytes(15)) is None
    assert wire.hex() == "f801" + "030c" + "b4a69800" + "e6000000" + "0400" + "0000"
    assert feature_request(5) == b"\xfe\x05"
    assert product_request() == b"\xf9\x00"


def test_the_package_of_adafruit_reads_the_same_rotation() -> None:
    package = adafruit("adafruit_bno08x")
    report = HubReport(HubReportId.ROTATION_VECTOR, 1, 3, 0, (0.5, -0.25, 0.75, 0.125, 0.0))
    values, accuracy = package._parse_sensor_report_data(bytearray(encode_report(report)))
    assert values == report.values[:4]
    assert accuracy == 3
