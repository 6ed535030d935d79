"""Numbers at any position of a frame have the values that an independent DBC reader returns."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_protocols.table import FieldReader, TableField, overlaps, parse_type, slot_quantities

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_protocols.table import ByteOrder, Kind

cantools: Any = pytest.importorskip("cantools")


def dbc_signal(name: str, field: TableField) -> str:
    """Return the line of a DBC file; a big-endian signal starts at its most significant bit."""
    big = field.byte_order == "big"
    start = 8 * field.offset + (7 - field.bit if big else field.bit)
    sign = "+" if field.kind == "u" else "-"
    return f' SG_ {name} : {start}|{field.bits}@{0 if big else 1}{sign} (1,0) [0|0] "" H'


def independent_values(fields: Sequence[TableField], data: bytes) -> list[float]:
    lines = ['VERSION ""', "BU_: H", "BO_ 1 M: 8 H"]
    lines += [dbc_signal(f"S{at}", field) for at, field in enumerate(fields)]
    lines += [
        f"SIG_VALTYPE_ 1 S{at} : {field.bits // 32};"
        for at, field in enumerate(fields)
        if field.kind == "f"
    ]
    message = cantools.database.load_string("\n".join(lines), "dbc").get_message_by_name("M")
    values = message.decode(data, scaling=False)
    return [values[f"S{at}"] for at in range(len(fields))]


@st.composite
def layouts(draw: st.DrawFn) -> list[TableField]:
    """Draw fields of one CAN frame that do not overlap, in any order."""
    fields: list[TableField] = []
    for _ in range(draw(st.integers(1, 5))):
        order: ByteOrder = draw(st.sampled_from(("little", "big")))
        kind: Kind = draw(st.sampled_from(("u", "i", "u", "i", "f")))
        bits = draw(st.sampled_from((32, 64))) if kind == "f" else draw(st.integers(1, 64))
        first = draw(st.integers(0, 64 - bits))
        first -= first % 8 if kind == "f" else 0
        field = TableField(first // 8, kind, bits, order, first % 8)
        named = {str(at): each for at, each in enumerate([*fields, field])}
        if field.end <= 8 and not overlaps(named):
            fields.append(field)
    return fields or [TableField(0, "i", 16)]


@settings(max_examples=60, deadline=None)
@given(layouts(), st.binary(min_size=8, max_size=8))
def test_every_place_reads_as_in_a_dbc_file(fields: list[TableField], data: bytes) -> None:
    ours = FieldReader(fields).read(b"\xff" + data, 1)
    # Texts are compared, because NaN is not equal to NaN.
    assert repr([*ours]) == repr(independent_values(fields, data))


@given(layouts(), st.data())
def test_written_numbers_are_read_again(fields: list[TableField], data: st.DataObject) -> None:
    low = {"u": 0, "i": -1, "f": -1}
    values = [
        data.draw(
            st.integers(low[field.kind] << max(field.bits - 2, 0), (1 << field.bits) // 2 - 1)
        )
        if field.kind != "f"
        else struct.unpack("f", struct.pack("f", data.draw(st.floats(width=32, allow_nan=False))))[
            0
        ]
        for field in fields
    ]
    frame = bytearray(8)
    reader = FieldReader(fields)
    reader.write(frame, values)
    assert list(reader.read(bytes(frame), 0)) == values


def test_a_number_that_does_not_fit_is_refused() -> None:
    with pytest.raises(OverflowError, match="does not fit u12"):
        FieldReader([TableField(0, "u", 12)]).write(bytearray(8), [4096])


def test_types_are_parsed_and_others_refused() -> None:
    assert parse_type("i16") == ("i", 16)
    assert parse_type("u3") == ("u", 3)
    assert parse_type("f64") == ("f", 64)
    assert [parse_type(text) for text in ("f20", "i65", "u0", "int16", "")] == [None] * 5


def test_a_signed_number_has_at_least_two_bits() -> None:
    assert parse_type("i1") is None
    assert parse_type("i2") == ("i", 2)
    assert parse_type("u1") == ("u", 1)


def test_floats_have_16_32_or_64_bits() -> None:
    found = [bits for bits in range(1, 100) if parse_type(f"f{bits}") is not None]
    assert found == [16, 32, 64]


def test_each_slot_belongs_to_one_quantity() -> None:
    names = ["quaternion"] * 4 + ["rate"] * 3 + ["acceleration"] * 3 + ["magnetic"] * 3
    names += ["time", "counter", "valid"]
    assert [slot_quantities([slot]) for slot in range(17)] == [*((name,) for name in names), ()]


def test_a_signed_number_of_63_bits_ignores_the_last_bit_of_its_bytes() -> None:
    read = FieldReader([TableField(0, "i", 63)]).read
    assert read(b"\x05" + bytes(6) + b"\x80", 0) == (5,)
    assert read(b"\xfb" + b"\xff" * 6 + b"\x7f", 0) == (-5,)


def test_overlaps_are_found_across_byte_orders() -> None:
    # A big-endian number of 12 bits at byte 0 does not occupy the low four bits of byte 1.
    big = TableField(0, "u", 12, "big")
    assert overlaps({"a": big, "b": TableField(1, "u", 4)}) == []
    assert overlaps({"a": big, "b": TableField(1, "u", 4, bit=4)}) == [("a", "b")]
    assert overlaps({"a": big, "b": TableField(1, "u", 8, frame=1)}) == []
