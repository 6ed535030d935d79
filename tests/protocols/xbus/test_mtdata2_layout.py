"""Decoding with a layout returns the same result as decoding item by item, or None."""

from __future__ import annotations

import struct

from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.xbus import MTData2Layout
from jointfit_protocols.xbus.mtdata2 import Item, Value, decode_item, encode_item, split

WANTED = {0x1020, 0x1060, 0x2010, 0x8020, 0xE010, 0xE020}
WIDTHS = {0x1020: 2, 0x1060: 4, 0xE010: 1, 0xE020: 4}
IDS = (
    0x1020,
    0x1060,
    0x2010,
    0x2014,
    0x2018,
    0x2011,
    0x2013,
    0x8020,
    0xE010,
    0xE020,
    0x4020,
    0x9999,
)


@st.composite
def items(draw: st.DrawFn, ids: list[int]) -> bytes:
    out = b""
    for data_id in ids:
        size = WIDTHS.get(data_id)
        if size is None:
            size = {0x2011: 16, 0x2013: 32, 0x8020: 12, 0x4020: 12, 0x9999: 5}.get(data_id, 16)
        raw = draw(st.binary(min_size=size, max_size=size))
        out += struct.pack(">HB", data_id, size) + raw
    return out


def one_by_one(data: bytes) -> dict[int, Value]:
    found: dict[int, Value] = {}
    for data_id, raw in split(data) or []:
        if data_id & 0xFFF0 in WANTED:
            value = decode_item(data_id, raw)
            assert value is not None
            found[data_id & 0xFFF0] = value
    return found


@given(st.data(), st.lists(st.sampled_from(IDS), min_size=1, max_size=7))
def test_the_next_message_reads_as_item_by_item(data: st.DataObject, ids: list[int]) -> None:
    first, second = data.draw(items(ids)), data.draw(items(ids))
    layout = MTData2Layout.of(split(first) or [], WANTED)
    if {0x2011, 0x2013} & {*ids}:  # fixed point and doubles are decoded item by item
        assert layout is None
        return
    assert layout is not None
    found, expected = layout.read(second), one_by_one(second)
    assert found is not None
    # Texts are compared, because NaN is not equal to NaN.
    assert sorted(map(repr, found.items())) == sorted(map(repr, expected.items()))


@given(st.binary(max_size=60), st.permutations([0x1020, 0x1060, 0x2010]))
def test_another_order_or_size_is_not_read(noise: bytes, ids: list[int]) -> None:
    usual: list[tuple[int, Value]] = [(0x1020, 7), (0x1060, 8), (0x2010, (1.0, 0.0, 0.0, 0.0))]
    values = dict(usual)
    known = b"".join(encode_item(data_id, value) for data_id, value in usual)
    layout = MTData2Layout.of(split(known) or [], WANTED)
    assert layout is not None
    other = b"".join(encode_item(data_id, values[data_id]) for data_id in ids)
    assert (layout.read(other) is None) == (other != known)
    assert layout.read(noise) is None or noise[:3] == known[:3]


def test_the_world_is_that_of_the_quaternion() -> None:
    ned = Item.QUATERNION | 0x4
    wire = encode_item(Item.PACKET_COUNTER, 1) + encode_item(ned, (1.0, 0.0, 0.0, 0.0))
    layout = MTData2Layout.of(split(wire) or [], WANTED)
    assert layout is not None
    assert layout.world_id == ned
    assert layout.read(wire.replace(b"\x20\x14", b"\x20\x10")) is None


def test_empty_output_list_has_no_layout() -> None:
    assert MTData2Layout.of([], WANTED) is None
