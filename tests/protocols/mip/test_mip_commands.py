"""Numbers, layouts and limits of MIP commands and fields agree with the vendor's library."""

from __future__ import annotations

import struct

import pytest

from jointfit_protocols.mip import MAX_PACKET, MipPacket, commands, data, encode
from jointfit_protocols.mip.commands import Base, CommandSet, FilterSetup, Function, Setup
from jointfit_protocols.mip.data import DataSet, FilterField, SensorField, SharedField


def test_descriptors_are_those_of_the_vendors_library() -> None:
    assert [each.value for each in CommandSet] == [0x01, 0x0C, 0x0D]
    assert [each.value for each in Base] == [
        0x01, 0x02, 0x03, 0x04, 0x06, 0x07, 0x09, 0x81, 0x82, 0x86, 0x89,
    ]  # fmt: skip
    assert [each.value for each in Setup] == [
        0x06, 0x08, 0x0A, 0x0B, 0x0E, 0x0F, 0x11, 0x30, 0x32, 0x40,
        0x80, 0x82, 0x83, 0x85, 0x87, 0x8A, 0x8E, 0x8F, 0xB2,
    ]  # fmt: skip
    assert [each.value for each in FilterSetup] == [0x11, 0x81]
    assert [each.value for each in Function] == [1, 2, 3, 4, 5]
    assert [each.value for each in DataSet] == [0x80, 0x82, 0xA0]
    assert [each.value for each in SharedField] == [0xD0, 0xD3, 0xD5, 0xD6, 0xD7]
    assert [each.value for each in SensorField] == [0x04, 0x05, 0x06, 0x0A, 0x0C, 0x12]
    assert [each.value for each in FilterField] == [0x03, 0x05, 0x10, 0x11]
    assert (commands.REPLY, commands.OK, MAX_PACKET) == (0xF1, 0, 261)


def test_each_family_has_its_commands_for_rate_format_and_stream() -> None:
    assert commands.stream_commands("legacy", 0x80) == (0x06, 0x83, 0x08, 0x80, b"", 1)
    assert commands.stream_commands("legacy", 0x82) == (0x0B, 0x8A, 0x0A, 0x82, b"", 3)
    for number in (0x80, 0x82, 0xA0):
        found = commands.stream_commands("current", number)
        assert found == (0x0E, 0x8E, 0x0F, 0x8F, bytes((number,)), number)


def test_codes_have_a_text() -> None:
    texts = (
        "unknown command",
        "invalid checksum",
        "invalid parameter",
        "command failed",
        "timeout",
    )
    for code in range(7):
        known = 1 <= code <= 5
        text = texts[code - 1] if known else "unknown to this version"
        assert commands.code_text(code) == f"code {code}, {text}"


def test_the_code_is_that_of_the_reply_to_the_command() -> None:
    packet = MipPacket(1, ((0xF1, b"\x02\x04"), (0xF1, b"\x03"), (0xF0, b"\x05\x00")), 0)
    assert commands.reply_code(packet, 2) == 4
    assert commands.reply_code(packet, 3) is commands.reply_code(packet, 5) is None
    assert commands.reply_data(packet, 0xF0) == b"\x05\x00"
    assert commands.reply_data(packet, 0xF2) is None


def test_device_information_has_its_documented_layout() -> None:
    info = commands.DeviceInformation(1105, "3DM-CV7", "6286-9910", "6286.1234", "", "8g, 300d/s")
    wire = commands.encode_info(info)
    texts = [text.ljust(16).encode() for text in info[1:]]
    assert wire == struct.pack(">H", 1105) + b"".join(texts)
    assert commands.decode_info(wire) == info
    assert commands.decode_info(wire[:-1]) is None
    assert info.version == "1.1.05"
    assert info._replace(firmware=12_345).version == "12.3.45"


def test_descriptors_and_formats_have_their_documented_layout() -> None:
    wire = commands.encode_descriptors([0x0C0F, 0x8004])
    assert wire.hex() == "0c0f8004"
    assert commands.decode_descriptors(wire) == {0x0C0F, 0x8004}
    assert commands.decode_descriptors(wire + b"\1") == {0x0C0F, 0x8004}
    assert commands.decode_descriptors(b"\1") == frozenset()

    outputs = commands.encode_outputs(b"\x80", [(4, 10), (0xD5, 258)])
    assert outputs.hex() == "8002" + "04000a" + "d50102"
    assert commands.decode_outputs(b"\x80", outputs) == ((4, 10), (0xD5, 258))
    assert commands.decode_outputs(b"", outputs[1:]) == ((4, 10), (0xD5, 258))
    for wrong in (outputs[:-1], outputs + b"\0", b"\x82" + outputs[1:], b"\x80", b""):
        assert commands.decode_outputs(b"\x80", wrong) is None


def test_a_format_has_at_most_82_entries() -> None:
    for count in (82, 83):
        wire = commands.encode_outputs(b"\x80", [(4, 1)] * count)
        found = commands.decode_outputs(b"\x80", wire)
        assert (found is not None) == (count == 82)


def test_rates_and_transforms_have_their_documented_layout() -> None:
    assert commands.encode_rate(b"\x80", 1000).hex() == "8003e8"
    assert commands.decode_rate(b"\x80", b"\x80\x03\xe8") == 1000
    assert commands.decode_rate(b"", b"\x03\xe8") == 1000
    for wrong in (b"\x80\x03", b"\x80\x03\xe8\0", b"\x82\x03\xe8"):
        assert commands.decode_rate(b"\x80", wrong) is None
    assert commands.encode_floats(1.0, -2.0).hex() == "3f800000" + "c0000000"
    assert commands.decode_floats(bytes(16), 4) == (0.0,) * 4
    assert commands.decode_floats(bytes(16), 3) is None


SHARED_SIZES = {0xD0: 1, 0xD3: 12, 0xD5: 8, 0xD6: 8, 0xD7: 10}


@pytest.mark.parametrize(
    ("number", "sizes"),
    [
        (0x80, {4: 12, 5: 12, 6: 12, 0x0A: 16, 0x0C: 12, 0x12: 12}),
        (0x82, {3: 18, 5: 14, 0x10: 6, 0x11: 12}),
        (0xA0, {}),
    ],
)
def test_fields_have_the_documented_sizes(number: int, sizes: dict[int, int]) -> None:
    known = sizes | SHARED_SIZES
    for field in range(256):
        found = [size for size in range(20) if data.decode_field(number, field, bytes(size))]
        assert found == ([known[field]] if field in known else [])
        if field in known:
            assert data.field_bytes(number, field) == known[field] + 2


def test_documented_fields_are_known() -> None:
    shared = {*range(0xD0, 0xD9)}
    assert data.known_fields(0x80) == frozenset({*range(1, 0x19), 0x40} | shared)
    assert data.known_fields(0x82) == frozenset({*range(1, 0x52)} | shared)
    every = frozenset(range(256))
    others = [number for number in range(256) if data.known_fields(number) == every]
    assert others == [0x81, 0x90, 0x91, 0x92, 0x93, 0x94, 0x95, 0xA0]
    assert data.known_fields(0x83) is None


def test_gps_time_counts_from_its_epoch() -> None:
    week_ns = 604_800_000_000_000
    assert data.gps_ns(0, 0.0) == 0
    assert data.gps_ns(2, 1.5) == 2 * week_ns + 1_500_000_000
    assert data.gps_ns(0, 999_999_999.0) == 999_999_999_000_000_000
    assert data.gps_ns(0, 1e9) is data.gps_ns(0, -1e-9) is data.gps_ns(0, float("nan")) is None
    assert data.STANDARD_GRAVITY == 9.80665


def test_a_command_packet_has_one_field() -> None:
    wire = commands.encode_command(CommandSet.SETUP, Setup.STREAM, b"\1\x80\1")
    assert wire == encode(0x0C, ((0x11, b"\1\x80\1"),))
    assert commands.encode_command(1, 1) == encode(1, ((1, b""),))
