"""MTData of older devices: output mode and settings determine fields and number formats."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.xbus import mtdata
from jointfit_protocols.xbus.mtdata import (
    EULER,
    FORMAT_SHIFT,
    MATRIX,
    NED,
    NO_ACCELERATION,
    NO_INPUT_1,
    NO_MAGNETIC,
    SAMPLE_COUNTER,
    UTC_TIME,
    MTDataLayout,
    OutputMode,
    decode_output_mode,
    decode_output_settings,
    rate_hz,
)
from jointfit_protocols.xbus.mtdata2 import Item

CALIBRATED_QUATERNION = OutputMode.CALIBRATED | OutputMode.ORIENTATION
MODES = st.lists(st.sampled_from(list(OutputMode)), unique=True).map(sum)
SETTINGS = st.builds(
    lambda stamps, kind, left_out, reals, inputs, ned: (
        stamps | kind | left_out << 4 | reals << FORMAT_SHIFT | inputs << 10 | ned
    ),
    st.integers(0, 3),
    st.sampled_from([0, EULER, MATRIX]),
    st.integers(0, 7),
    st.integers(0, 3),
    st.integers(0, 3),
    st.sampled_from([0, NED]),
)


def test_calibrated_data_quaternion_and_counter_are_at_their_places() -> None:
    data = struct.pack(">9f4fH", *range(9), 0.5, -0.5, 0.5, 0.5, 65_535)
    layout = MTDataLayout(CALIBRATED_QUATERNION, SAMPLE_COUNTER)
    assert layout.size == len(data) == 54
    assert layout.read(data) == {
        Item.ACCELERATION: (0.0, 1.0, 2.0),
        Item.RATE_OF_TURN: (3.0, 4.0, 5.0),
        Item.MAGNETIC_FIELD: (6.0, 7.0, 8.0),
        Item.QUATERNION: (0.5, -0.5, 0.5, 0.5),
        Item.PACKET_COUNTER: 65_535,
    }
    assert layout.read(data + b"\0") is None


def test_fields_that_are_not_used_are_skipped_by_their_size() -> None:
    mode = (OutputMode.RAW_INERTIAL | OutputMode.TEMPERATURE | OutputMode.CALIBRATED
            | OutputMode.ORIENTATION | OutputMode.AUXILIARY | OutputMode.STATUS)  # fmt: skip
    settings = SAMPLE_COUNTER | UTC_TIME | EULER | NO_ACCELERATION | NO_MAGNETIC | NO_INPUT_1
    data = bytes(20) + struct.pack(">f3f3fHBH", 25.0, 1, 2, 3, 10, 20, 30, 7, 2, 400) + bytes(12)
    assert MTDataLayout(mode, settings).read(data) == {
        Item.RATE_OF_TURN: (1.0, 2.0, 3.0),
        Item.EULER_ANGLES: (10.0, 20.0, 30.0),
        Item.STATUS_BYTE: 2,
        Item.PACKET_COUNTER: 400,
    }


@pytest.mark.parametrize(
    ("reals", "wire"),
    [(1, "00180000 fff80000 00000000 00100000"),
     (2, "800000000001 80000000ffff 000000000000 000000000001"),
     (3, "3ff8000000000000 bfe0000000000000 0000000000000000 3ff0000000000000")],
)  # fmt: skip
def test_fixed_point_and_double_reals_are_decoded(reals: int, wire: str) -> None:
    values = MTDataLayout(OutputMode.ORIENTATION, reals << FORMAT_SHIFT).read(bytes.fromhex(wire))
    assert values == {Item.QUATERNION: (1.5, -0.5, 0.0, 1.0)}


@given(MODES, SETTINGS, st.data())
def test_every_mode_is_read_as_written(mode: int, settings: int, data: st.DataObject) -> None:
    layout = MTDataLayout(mode, settings)
    values = {
        field.item: (
            data.draw(st.tuples(*(st.integers(-2000, 2000).map(lambda n: n / 8),) * field.reals))
            if field.reals
            else data.draw(st.integers(0, 256**field.size - 1))
        )
        for field in layout.fields
    }
    wire = layout.write(values)
    assert layout.read(wire) == values
    assert layout.items == set(values)


@given(MODES, SETTINGS, st.binary(max_size=120))
def test_random_bytes_are_values_or_refused_by_their_length(
    mode: int, settings: int, noise: bytes
) -> None:
    layout = MTDataLayout(mode, settings)
    assert (layout.read(noise) is None) == (len(noise) != layout.size)


@pytest.mark.parametrize(
    ("mode", "settings", "size"),
    [
        (0x0001, 0, 4),
        (0x0001, 0x200, 6),
        (0x0001, 0x300, 8),
        (0x0002, 0, 36),
        (0x0002, 0x10, 24),
        (0x0002, 0x20, 24),
        (0x0002, 0x40, 24),
        (0x0002, 0x70, 0),
        (0x0004, 0, 16),
        (0x0004, 0x4, 12),
        (0x0004, 0x8, 36),
        (0x0004, 0x108, 36),
        (0x0008, 0, 4),
        (0x0008, 0x400, 2),
        (0x0008, 0x800, 2),
        (0x0008, 0xC00, 0),
        (0x0010, 0, 12),
        (0x0010, 0x300, 24),
        (0x0020, 0, 12),
        (0x0020, 0x200, 18),
        (0x0800, 0, 1),
        (0x1000, 0, 44),
        (0x4000, 0, 20),
        (0, 0x1, 2),
        (0, 0x2, 12),
        (0, 0x8000_0000, 0),
    ],
)
def test_a_bit_of_mode_or_settings_adds_the_documented_bytes(
    mode: int, settings: int, size: int
) -> None:
    assert MTDataLayout(mode, settings).size == size


def test_fields_have_the_documented_order() -> None:
    layout = MTDataLayout(sum(OutputMode), SAMPLE_COUNTER | UTC_TIME)
    assert [(field.item, field.start, field.size, field.reals) for field in layout.fields] == [
        (Item.ACCELERATION, 68, 12, 3),
        (Item.RATE_OF_TURN, 80, 12, 3),
        (Item.MAGNETIC_FIELD, 92, 12, 3),
        (Item.QUATERNION, 104, 16, 4),
        (Item.STATUS_BYTE, 148, 1, 0),
        (Item.PACKET_COUNTER, 149, 2, 0),
    ]
    assert layout.size == 163


def test_fields_without_a_value_are_zeros() -> None:
    layout = MTDataLayout(CALIBRATED_QUATERNION, SAMPLE_COUNTER)
    wire = layout.write({Item.PACKET_COUNTER: 3, Item.QUATERNION: (1.0, 0.0, 0.0, 0.0)})
    assert wire == bytes(36) + struct.pack(">4fH", 1, 0, 0, 0, 3)


def test_a_configuration_of_one_device_has_mode_and_settings() -> None:
    def configuration(devices: int) -> bytes:
        words = struct.pack(">H6xHI", devices, 0x0806, 0x8000_0001)
        return bytes(96) + words + bytes(8)

    assert mtdata.decode_device_configuration(configuration(1)) == (0x0806, 0x8000_0001)
    assert mtdata.decode_device_configuration(configuration(2)) is None
    assert mtdata.decode_device_configuration(configuration(0)) is None
    assert mtdata.decode_device_configuration(configuration(1) + b"\0") is None


def test_an_unknown_mode_is_refused() -> None:
    with pytest.raises(ValueError, match="is unknown"):
        MTDataLayout(0x0100, 0)


def test_replies_of_the_device_have_mode_settings_and_rate() -> None:
    assert decode_output_mode(b"\x00\x06") == 6
    assert decode_output_settings(b"\x80\x00\x00\x01") == NED | SAMPLE_COUNTER
    assert decode_output_mode(b"") is decode_output_settings(b"\x00") is None
    assert rate_hz(struct.pack(">H", 1152), b"") == 100.0
    assert rate_hz(struct.pack(">H", 1152), b"\x00\x01") == 50.0
    assert rate_hz(b"\x00\x00", b"") is rate_hz(b"", b"") is None
    assert rate_hz(b"\x01\x00\x00", b"") is rate_hz(b"\x01\x00", b"\x01") is None
    assert decode_output_mode(bytes(3)) is decode_output_settings(bytes(5)) is None
    assert mtdata.COUNTS == 1 << 16
