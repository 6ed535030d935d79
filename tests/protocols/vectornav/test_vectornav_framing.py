"""The VectorNav codec counts every byte of any stream, however the stream is split."""

from __future__ import annotations

import itertools
import struct
from binascii import crc_hqx
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols import xbus
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.vectornav import (
    MAX_MESSAGE,
    BinaryLayout,
    BinaryPacket,
    Field,
    TextMessage,
    VectorNavCodec,
    VectorNavMessage,
    encode_binary,
    encode_text,
    registers,
)
from jointfit_protocols.vectornav._layout import _FORMATS

ORIENTATION: dict[int, tuple[float, ...]] = {
    Field.TIME_STARTUP: (1_000_000,),
    Field.QUATERNION: (0.5, -0.5, 0.1, 0.7),
}

binaries = st.builds(
    lambda t, q: encode_binary({Field.TIME_STARTUP: (t,), Field.QUATERNION: q}),
    st.integers(0, 2**64 - 1),
    st.tuples(*[st.floats(-1, 1, width=32)] * 4),
)
texts = st.builds(
    lambda text: encode_text(f"VNRRG,{text}"), st.text("0123456789.-+ABC,", max_size=60)
)
false_heads = st.sampled_from(
    [b"\xfa", b"\xfa\x01", b"\xfa\x01\x11\x00", b"$VN", b"$VNRRG,1*00\r\n"]
)
wires = st.lists(binaries | texts | st.binary(max_size=30) | false_heads, max_size=8).map(b"".join)


def decode(
    chunks: list[bytes],
) -> tuple[list[VectorNavMessage | CorruptBytes], VectorNavCodec]:
    codec = VectorNavCodec()
    found = [event for chunk in chunks for event in codec.feed(chunk)]
    return found + codec.flush(), codec


@given(wires, st.lists(st.integers(0, 5000), max_size=10))
def test_chunk_boundaries_do_not_change_the_messages(wire: bytes, cuts: list[int]) -> None:
    whole, _ = decode([wire])
    at = sorted({0, len(wire), *(place % (len(wire) + 1) for place in cuts)})
    assert decode([wire[a:b] for a, b in itertools.pairwise(at)])[0] == whole
    assert decode([bytes([byte]) for byte in wire])[0] == whole


@given(wires)
def test_every_byte_is_in_a_message_or_counted(wire: bytes) -> None:
    found, codec = decode([wire])
    used = sum(event.size for event in found if not isinstance(event, CorruptBytes))
    lost = sum(event.discarded for event in found if isinstance(event, CorruptBytes))
    assert used + lost == len(wire)
    assert lost == codec.discarded
    assert codec.messages == sum(not isinstance(event, CorruptBytes) for event in found)


@given(st.lists(st.binary(max_size=2000), max_size=5))
def test_pending_bytes_are_bounded(chunks: list[bytes]) -> None:
    codec = VectorNavCodec()
    for chunk in chunks:
        codec.feed(b"\xfa\x7f" + chunk + b"$VN")
        assert codec.pending < MAX_MESSAGE


@given(st.integers(0, 2**64 - 1), st.tuples(*[st.floats(-1, 1, width=32)] * 4))
def test_an_encoded_output_decodes_to_itself(t_ns: int, q: tuple[float, ...]) -> None:
    wire = encode_binary({Field.TIME_STARTUP: (t_ns,), Field.QUATERNION: q})
    ((packet,), _) = decode([wire])
    assert isinstance(packet, BinaryPacket)
    assert packet.values[packet.layout.places[Field.TIME_STARTUP]] == (t_ns,)
    assert packet.values[packet.layout.places[Field.QUATERNION]] == q
    assert (packet.size, packet.end) == (len(wire), len(wire))


def test_an_output_has_the_documented_bytes() -> None:
    """An output with fields 0 and 4 of the common group has 1 + 1 + 2 + 8 + 16 + 2 bytes."""
    wire = encode_binary(ORIENTATION)
    body = b"\x01\x11\x00" + struct.pack("<Q4f", 1_000_000, 0.5, -0.5, 0.1, 0.7)
    assert wire[:1] + wire[1:-2] == b"\xfa" + body
    crc = 0
    for byte in body:  # the CRC as the manual computes it
        crc = (crc >> 8 | crc << 8) & 0xFFFF
        crc ^= byte
        crc ^= (crc & 0xFF) >> 4
        crc = (crc ^ crc << 12) & 0xFFFF
        crc ^= (crc & 0xFF) << 5
    assert wire[-2:] == crc.to_bytes(2, "big")


def test_fields_have_the_numbers_of_the_manual() -> None:
    assert {field.name: field.value for field in Field} == {
        "TIME_STARTUP": 0x000, "YAW_PITCH_ROLL": 0x003, "QUATERNION": 0x004,
        "ANGULAR_RATE": 0x005, "ACCELERATION": 0x008, "MAGNETIC_AND_PRESSURE": 0x00A,
        "TIME_GROUP_STARTUP": 0x100, "IMU_MAGNETIC_FIELD": 0x208, "IMU_ACCELERATION": 0x209,
        "IMU_ANGULAR_RATE": 0x20A, "ATTITUDE_STATUS": 0x400, "ATTITUDE_QUATERNION": 0x402,
    }  # fmt: skip
    assert [register.value for register in registers.Register] == [1, 3, 4, 5, 6, 7, 9, 26, 75]
    assert registers.BOTH_PORTS == 3
    assert registers.decode_rotation([str(number) for number in range(10)]) == tuple(range(9))
    assert registers.decode_rotation(["1"] * 8) is None
    assert registers.decode_rotation(["x"] * 9) is None


@pytest.mark.parametrize("group", [*range(7), 12])
def test_field_sizes_equal_those_of_the_vendors_library(group: int) -> None:
    # The last two sizes belong to the fields 17 and 18.
    gnss = [8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28, 2, 8]
    sizes = [
        [8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8],
        [8, 8, 8, 2, 8, 8, 8, 4, 4, 1],
        [2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2, 40],
        gnss,
        [2, 12, 16, 36, 12, 12, 12, 12, 12, 12, 28, 24, 12, 4],
        [2, 24, 24, 12, 12, 12, 12, 12, 12, 4, 4, 68, 64],
        gnss,
    ]
    known = [struct.calcsize("<" + code) for code in _FORMATS[group].values()]
    assert known == (gnss if group == 12 else sizes[group])


@pytest.mark.parametrize(
    ("head", "behind"),
    [
        (b"\x81\x10\x11\x00\x04\x00", b"\x34\x09"),  # group 13 (GNSS 3): week
        (b"\x09\x11\x00\x10\x80\x06\x00", bytes(1 + 2 + 8)),  # GNSS: fix, status, altitude
        (b"\x89\x10\x11\x00\x01\x80\x02\x00\x08\x00", bytes(8 + 2 + 1)),
        (b"\x11\x11\x00\x00\x30", bytes(12 + 4)),  # attitude: heave, uncertainty
    ],
)
def test_groups_and_fields_of_firmware_from_2023_leave_the_orientation_in_place(
    head: bytes, behind: bytes
) -> None:
    body = head + struct.pack("<Q4f", 7, 0.5, -0.5, 0.25, 0.75) + behind
    wire = b"\xfa" + body + struct.pack(">H", crc_hqx(body, 0))
    for cut in (1, len(wire)):
        found, codec = decode([wire[at : at + cut] for at in range(0, len(wire), cut)] * 2)
        assert codec.messages == len(found) == 2
        for packet in found:
            assert isinstance(packet, BinaryPacket)
            assert packet.values[packet.layout.places[Field.TIME_STARTUP]] == (7,)
            assert packet.values[packet.layout.places[Field.QUATERNION]] == (0.5, -0.5, 0.25, 0.75)
            assert packet.layout.header == head


def test_messages_with_the_same_header_share_one_layout() -> None:
    wires = [encode_binary(ORIENTATION | {Field.TIME_STARTUP: (time,)}) for time in (1, 2)]
    first, second = decode(wires)[0]
    assert isinstance(first, BinaryPacket)
    assert isinstance(second, BinaryPacket)
    assert first.layout is second.layout


@given(binaries | texts, st.integers(0, 10_000), st.integers(0, 7))
def test_a_single_flipped_bit_never_passes(wire: bytes, place: int, bit: int) -> None:
    bad = bytearray(wire)
    bad[place % len(wire)] ^= 1 << bit
    found, _ = decode([bytes(bad)])
    whole = [one for one in found if not isinstance(one, CorruptBytes) and one.size == len(wire)]
    # hexadecimal digits of the checksum may be upper or lower case
    assert not whole or bytes(bad).upper() == wire.upper()


@pytest.mark.parametrize(
    ("wire", "reason"),
    [
        (b"abc", "no message starts here"),
        (b"\xfa\xff\x36\x00\x99", "header unknown to this version"),
        (b"\xfa\x01\x00\x80" + bytes(9), "header unknown to this version"),
        (b"abc" + encode_binary(ORIENTATION)[:-1] + b"\x00", "checksum"),
        (b"\xfa\x01\x11\x00abc", "cut off"),
        (b"$VNRRG,1*00\r\n", "malformed text"),
        (b"$VN\x00", "malformed text"),
    ],
)
def test_a_run_has_the_reason_of_its_first_real_fault(wire: bytes, reason: str) -> None:
    """A run of corrupt bytes is reported once. Bytes that begin no message are no real fault."""
    assert decode([wire])[0] == [CorruptBytes(len(wire), reason)]


def test_text_messages_with_either_checksum_are_read() -> None:
    documented = (
        b"$VNRRG,01,VN-200T-CR*31\r\n",
        b"$VNWRG,07,2*6F\r\n",
        b"$VNERR,12*72\r\n",
        b"$VNWNV*57\r\n",
        b"$VNWRG,75,3,16,01,0721*D415\r\n",
    )
    found, codec = decode([b"".join(documented)])
    assert codec.discarded == 0
    messages = [one for one in found if isinstance(one, TextMessage)]
    assert [one.register for one in messages] == [1, 7, None, None, 75]
    assert [one.error for one in messages] == [None, None, 12, None, None]
    assert messages[0].values == ("01", "VN-200T-CR")
    for wire in documented[:4]:
        assert encode_text(wire[1:].partition(b"*")[0].decode()) == wire


def test_no_message_of_one_family_is_one_of_the_other() -> None:
    """Both start with FA, but an Xbus header announces groups that VectorNav does not have."""
    other = [xbus.encode(0x36, bytes(range(size))) for size in range(0, 255, 7)]
    assert decode(other)[1].messages == 0
    codec = xbus.XbusCodec()
    for number in range(200):
        codec.feed(encode_binary(ORIENTATION | {Field.TIME_STARTUP: (number * 10_000_000,)}))
    assert codec.messages < 5


def test_a_text_that_is_none_is_a_bug_of_the_caller() -> None:
    with pytest.raises(ValueError, match="no message"):
        encode_text("hello")


outputs = st.builds(
    registers.BinaryOutput,
    st.integers(0, 3),
    st.integers(1, 800),
    st.sets(st.sampled_from(list(Field)), min_size=1).map(lambda one: BinaryLayout(one).fields),
)


@given(outputs)
def test_an_output_register_decodes_to_itself(output: registers.BinaryOutput) -> None:
    text = registers.encode_output(output)
    assert registers.decode_output(text.split(",")) == output


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2,8,01,0011", (2, 8, (0x00, 0x04))),
        ("3,16,11,0001,0106", (3, 16, (0x00, 0x401, 0x402, 0x408))),
        ("0,0,00", (0, 0, ())),
        ("0,1,00,0000", (0, 1, ())),
        ("1,8,89,10,0010,8001,0002,0004", (1, 8, (0x04, 0x300, 0x311, 0xC02))),
        ("0,1,01", None),
        ("x", None),
        ("1,8,01,8000", None),
        ("1,8,81,0001", None),
    ],
)
def test_an_output_register_as_text(text: str, expected: Any) -> None:
    found = registers.decode_output(text.split(","))
    assert found == (None if expected is None else registers.BinaryOutput(*expected))
