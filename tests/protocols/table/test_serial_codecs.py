"""Codecs of frames and lines that a table describes: splits, damage, and other messages."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.table import (
    Checksum,
    FrameCodec,
    FrameFormat,
    LineCodec,
    LineFormat,
    TableField,
    TableMessage,
    encode_frame,
    encode_line,
)

FIELDS = {
    **{slot: TableField(4 + 2 * slot, "i", 16, "big") for slot in range(4)},
    13: TableField(12, "u", 32),
    14: TableField(3, "u", 8),
}
SUM = Checksum("sum8", 2)
FIXED = FrameFormat(b"\xaa\x55", FIELDS, 18, checksum=SUM, end=b"\r")
BY_LENGTH = FIXED._replace(length=TableField(2, "u", 8), longest=64)
UNCHECKED = FIXED._replace(checksum=None, length=17)
LINES = LineFormat({slot: slot for slot in range(4)} | {13: 5}, prefix=b"$", width=6)
CHECKED_LINES = LINES._replace(checksum=Checksum("xor8", 1))
ALL = [FIXED, BY_LENGTH, UNCHECKED, LINES, CHECKED_LINES]
IDS = ["fixed", "length", "unchecked", "lines", "checked lines"]


def codec(form: FrameFormat | LineFormat) -> FrameCodec | LineCodec:
    return LineCodec(form) if isinstance(form, LineFormat) else FrameCodec(form)


def wire(form: FrameFormat | LineFormat, number: int) -> bytes:
    values = [number, -number, 2 * number, 100, 10 * number]
    if isinstance(form, LineFormat):
        return encode_line(form, values)
    size = 18 if not isinstance(form.length, int) else None
    return encode_frame(form, [*values, number], size)


def decode(form: FrameFormat | LineFormat, data: bytes, piece: int) -> list[object]:
    decoder, out = codec(form), []
    for at in range(0, len(data), piece):
        out += decoder.feed(data[at : at + piece])
        assert decoder.pending <= decoder.longest + 2  # two sync bytes may follow
    out += decoder.flush()
    lost = sum(item.discarded for item in out if isinstance(item, CorruptBytes))
    taken = sum(len(item.data) for item in out if isinstance(item, TableMessage))
    assert lost == decoder.discarded
    if not decoder.skipped:
        assert lost + taken == len(data)
    return [item for item in out if isinstance(item, TableMessage)]


@pytest.mark.parametrize("form", ALL, ids=IDS)
def test_every_message_arrives_whatever_the_split(form: FrameFormat | LineFormat) -> None:
    data = b"".join(wire(form, number) for number in range(60))
    for piece in (1, 5, 4096):
        found = decode(form, data, piece)
        assert len(found) == 60
        assert found[7].values[:5] == (7, -7, 14, 100, 70)  # type: ignore[attr-defined]


@pytest.mark.parametrize("form", ALL, ids=IDS)
def test_damage_costs_few_messages_and_the_split_none(form: FrameFormat | LineFormat) -> None:
    """The messages do not depend on the split of the damaged stream into chunks."""
    noise = random.Random(3)
    data = bytearray(b"".join(wire(form, number) for number in range(200)))
    for _ in range(10):
        data[noise.randrange(len(data))] ^= 1 << noise.randrange(8)
    del data[1000:1003]
    results = [decode(form, bytes(data), piece) for piece in (1, 7, 4096)]
    assert results[0] == results[1] == results[2]
    assert len(results[0]) >= 175


@pytest.mark.parametrize("form", [FIXED, BY_LENGTH, CHECKED_LINES], ids=IDS[:2] + IDS[4:])
def test_a_checksum_leaves_no_wrong_message(form: FrameFormat | LineFormat) -> None:
    noise = random.Random(4)
    sent = [wire(form, number) for number in range(200)]
    data = bytearray(b"".join(sent))
    for _ in range(60):
        data[noise.randrange(len(data))] ^= 1 << noise.randrange(8)
    clean = {decode(form, each, 4096)[0].values for each in sent}  # type: ignore[attr-defined]
    assert {each.values for each in decode(form, bytes(data), 50)} <= clean  # type: ignore[attr-defined]


@settings(max_examples=50, deadline=None)
@given(st.sampled_from(ALL), st.binary(max_size=300), st.integers(1, 300))
def test_random_bytes_never_raise(form: FrameFormat | LineFormat, data: bytes, piece: int) -> None:
    decode(form, data, piece)


def test_a_hostile_length_waits_for_no_more_than_the_longest_frame() -> None:
    decoder = FrameCodec(BY_LENGTH)
    decoder.feed(b"\xaa\x55\xff" + bytes(40))
    assert decoder.pending < 64
    assert decoder.feed(wire(BY_LENGTH, 3))


def test_frames_of_another_type_are_skipped_and_no_corrupt_bytes() -> None:
    form = BY_LENGTH._replace(message=(TableField(3, "u", 8), 9), fields={0: FIELDS[0]})
    other = encode_frame(form._replace(message=(TableField(3, "u", 8), 8)), [5])
    mine = encode_frame(form, [6])
    decoder = FrameCodec(form)
    items = decoder.feed(other + mine + other)
    assert [item.values for item in items if isinstance(item, TableMessage)] == [(6,)]
    assert (decoder.messages, decoder.skipped, decoder.discarded) == (3, 2, 0)


def test_a_frame_too_short_for_the_fields_is_corrupt_and_one_of_another_type_is_skipped() -> None:
    kind = TableField(3, "u", 8)
    form = BY_LENGTH._replace(message=(kind, 9), fields={0: FIELDS[0]})
    short = form._replace(fields={})
    decoder = FrameCodec(form)
    mine = encode_frame(short, [], 6)
    assert decoder.feed(mine) + decoder.flush() == [
        CorruptBytes(6, "frame of 6 bytes is too short for the fields")
    ]
    assert decoder.feed(encode_frame(short._replace(message=(kind, 8)), [], 6)) == []
    assert (decoder.skipped, decoder.discarded) == (1, 6)


def test_sync_bytes_inside_a_frame_without_checksum_begin_none() -> None:
    form = UNCHECKED
    evil = encode_frame(form, [-0x55AB, 1, 1, 1, 0x55AA55AA, 1])
    assert form.sync in evil[2:]
    assert len(decode(form, evil[5:] + evil * 20, 3)) == 20


def test_text_at_power_up_and_blank_lines_are_no_samples() -> None:
    decoder = LineCodec(LINES)
    items = decoder.feed(b"MPU ready\r\n\r\n" + wire(LINES, 1) + b"$1,2,3\r\n" + b"\xff\xfe\n")
    assert [type(item) for item in items] == [TableMessage]
    assert decoder.skipped == 2
    assert [item.reason for item in decoder.flush() if isinstance(item, CorruptBytes)] == [
        "3 columns"
    ]


@pytest.mark.parametrize("cell", [b"1_0", b"", b"0x10", b"one"])
def test_cells_that_are_no_numbers_are_refused(cell: bytes) -> None:
    decoder = LineCodec(LINES)
    decoder.feed(b"$1,2," + cell + b",4,5,6\n")
    assert decoder.messages == 0
    assert decoder.discarded > 0


def test_blanks_separate_columns_with_an_empty_separator() -> None:
    form = LineFormat({0: 0, 1: 2}, separator=b"")
    (item,) = LineCodec(form).feed(b"  1.5\t7   2e-3 \r\n")
    assert isinstance(item, TableMessage)
    assert item.values == (1.5, 0.002)


@pytest.mark.parametrize(
    ("width", "line", "reason"),
    [
        (None, b"1,2", "2 columns"),
        (None, b"1,2,3", None),
        (None, b"1,2,3,4", None),
        (4, b"1,2,3", "3 columns"),
        (4, b"1,2,3,4", None),
        (4, b"1,2,3,4,5", "5 columns"),
    ],
)
def test_a_line_has_all_columns_of_its_fields_and_the_configured_number(
    width: int | None, line: bytes, reason: str | None
) -> None:
    decoder = LineCodec(LineFormat({0: 0, 1: 2}, width=width))
    found = decoder.feed(line + b"\r\n") + decoder.flush()
    corrupt = [item.reason for item in found if isinstance(item, CorruptBytes)]
    assert corrupt == ([] if reason is None else [reason])
    assert decoder.messages == (reason is None)


@pytest.mark.parametrize("size", [1024, 1025])
def test_a_line_has_at_most_1024_bytes_before_its_end(size: int) -> None:
    decoder = LineCodec(LineFormat({0: 0}))
    decoder.feed(b"1".rjust(size))
    assert decoder.pending == (size if size == 1024 else 0)
    found = decoder.feed(b"\n2\n") + decoder.flush()
    values = [item.values for item in found if isinstance(item, TableMessage)]
    assert values == ([(1.0,), (2.0,)] if size == 1024 else [(2.0,)])


def test_a_line_without_end_is_discarded_in_pieces() -> None:
    decoder = LineCodec(LINES)
    for _ in range(100):
        decoder.feed(b"$" + b"1," * 200)
        assert decoder.pending <= 1024
    assert decoder.discarded > 30_000
