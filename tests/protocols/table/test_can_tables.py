"""Assembly of samples from the CAN frames that a table describes, with lost and foreign frames."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.can import CanFrame
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.table import (
    CanSample,
    CanTable,
    CanTableCodec,
    Multiplexer,
    TableField,
    encode_can_frames,
)

MS = 1_000_000
HALVES = CanTable(
    ((0x100, False), (0x110, False), (0x111, False)),
    {
        **{slot: TableField(4 * (slot % 2), "f", 32, frame=1 + slot // 2) for slot in range(4)},
        13: TableField(0, "u", 32, frame=0),
    },
    longest_ns=5 * MS,
    names=("time", "first", "second"),
)


def frames(number: int, t_ns: int) -> list[CanFrame]:
    sent = encode_can_frames(HALVES, [number, 2, 3, 4, 10 * number])
    return [CanFrame(t_ns + at, key[0], data, key[1]) for at, (key, data) in enumerate(sent)]


def test_frames_join_to_samples_with_the_stamp_of_the_first() -> None:
    codec = CanTableCodec(HALVES)
    found = [codec.feed(frame) for frame in frames(5, 1000)]
    assert found[:2] == [None, None]
    assert isinstance(found[2], CanSample)
    assert (found[2].t_ns, found[2].values) == (1000, (5, 2, 3, 4, 50))


def test_a_lost_time_leaves_the_sample_and_a_lost_half_none() -> None:
    """Without the time frame, a sample has no time. Without half of the quaternion, it is lost."""
    codec = CanTableCodec(HALVES)
    sent = [
        *frames(1, 0)[1:],
        *frames(2, 10 * MS)[:2],
        *frames(3, 20 * MS),
        *frames(4, 30 * MS)[2:],
    ]
    found = [item for frame in sent if isinstance(item := codec.feed(frame), CanSample)]
    assert [item.values for item in found] == [(1, 2, 3, 4, None), (3, 2, 3, 4, 30)]
    assert codec.incomplete == 2


def test_halves_of_different_samples_are_never_joined() -> None:
    codec = CanTableCodec(HALVES)
    assert codec.feed(frames(1, 0)[1]) is None
    assert codec.feed(frames(2, 10 * MS)[2]) is None
    assert codec.incomplete == 2


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 2), st.booleans()), max_size=60))
def test_any_order_of_frames_joins_neighbours_only(sent: list[tuple[int, int, bool]]) -> None:
    codec = CanTableCodec(HALVES)
    t_ns = 0
    for number, part, late in sent:
        t_ns += 10 * MS if late else 0
        sample = codec.feed(frames(number, t_ns)[part])
        assert sample is None or isinstance(sample, CanSample)


def test_short_frames_are_corrupt_and_foreign_ones_counted() -> None:
    codec = CanTableCodec(HALVES)
    short = codec.feed(CanFrame(0, 0x110, b"1234567"))
    assert isinstance(short, CorruptBytes)
    assert "first: 7 data bytes, expected 8" in short.reason
    assert codec.feed(CanFrame(0, 0x110, bytes(8), extended=True)) is None
    assert codec.foreign == 1


@given(
    st.integers(1, (1 << 16) - 1),
    st.lists(st.integers(0, (1 << 16) - 1), min_size=2, max_size=5, unique=True),
    st.data(),
)
def test_multiplexed_frames_are_found_by_the_bits_of_the_multiplexer(
    mask: int, values: list[int], data: st.DataObject
) -> None:
    pages = [Multiplexer(mask, frozenset({value & mask})) for value in values]
    table = CanTable(
        ((0x200, False),) * len(pages),
        {slot: TableField(2, "i", 24, frame=slot) for slot in range(len(pages))},
        multiplexers=dict(enumerate(pages)),
    )
    codec = CanTableCodec(table)
    numbers = [at * 1000 - 2000 for at in range(len(pages))]
    sent = [CanFrame(1, 0x200, each) for _, each in encode_can_frames(table, numbers)]
    noise = data.draw(st.integers(0, (1 << 16) - 1)) & ~mask
    frames = [
        frame._replace(
            data=(int.from_bytes(frame.data, "little") | noise).to_bytes(len(frame.data), "little")
        )
        for frame in sent
    ]
    distinct = all(one.excludes(other) for at, one in enumerate(pages) for other in pages[:at])
    assert distinct == (len({value & mask for value in values}) == len(values))
    if distinct:
        *rest, last = [codec.feed(frame) for frame in frames]
        assert rest == [None] * len(rest)
        assert isinstance(last, CanSample)
        assert last.values == tuple(numbers)


def test_an_unknown_page_is_foreign_and_a_short_one_corrupt() -> None:
    """A page is the content of a frame that one value of the multiplexer selects."""
    table = CanTable(
        ((0x200, False),),
        {0: TableField(2, "f", 32)},
        multiplexers={0: Multiplexer(0xFFFF, frozenset({0x0155}))},
    )
    codec = CanTableCodec(table)
    assert codec.feed(CanFrame(0, 0x200, b"\x55\x02" + bytes(4))) is None
    assert codec.feed(CanFrame(0, 0x200, b"\x55")) is None
    assert codec.foreign == 2
    assert isinstance(codec.feed(CanFrame(0, 0x200, b"\x55\x01" + bytes(3))), CorruptBytes)
    assert isinstance(codec.feed(CanFrame(0, 0x200, b"\x55\x01" + bytes(4))), CanSample)


def test_a_frame_too_short_for_the_multiplexer_is_foreign() -> None:
    # Missing bytes are not zeros.
    table = CanTable(
        ((0x200, False),),
        {0: TableField(0, "i", 8)},
        multiplexers={0: Multiplexer(0xFF00, frozenset({0}))},
    )
    codec = CanTableCodec(table)
    assert codec.feed(CanFrame(0, 0x200, b"\x05")) is None
    assert codec.foreign == 1
    assert isinstance(codec.feed(CanFrame(0, 0x200, b"\x05\x00")), CanSample)
