"""The XCDI codec agrees with the test vectors and with an independent DBC reader.

Groups are assembled for each sensor, and the unit of SampleTime is determined from the data.
"""

from __future__ import annotations

import json
import random
from math import isclose
from typing import TYPE_CHECKING, Any

import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_protocols.can import CanFrame
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.xcdi import (
    DataId,
    TickUnit,
    XcdiCodec,
    XcdiError,
    XcdiGroup,
    XcdiIds,
    decode,
    encode,
    id_block,
    layout,
    quaternion_counts,
)

if TYPE_CHECKING:
    from pathlib import Path

SIZES = {
    0x01: 1, 0x05: 4, 0x06: 2, 0x07: 8, 0x11: 4, 0x21: 8, 0x22: 6, 0x32: 6, 0x34: 6, 0x35: 6,
}  # fmt: skip
"""Length of the data of each message, bytes, in the manual."""
shorts = st.integers(-32768, 32767)
quaternions = st.tuples(shorts, shorts, shorts, shorts)
can_frames = st.builds(
    CanFrame,
    st.integers(0, 10**12),
    st.sampled_from([0x01, 0x05, 0x06, 0x11, 0x21, 0x22]) | st.integers(0, 0x7FF),
    st.binary(max_size=8),
    error=st.booleans(),
)


def vectors(shared_data: Path) -> list[dict[str, Any]]:
    everything = json.loads((shared_data / "imu" / "vectors.json").read_text())
    return [each for each in everything if each["protocol"] == "xsens-xcdi"]


def test_the_vectors(shared_data: Path) -> None:
    names = {0x05: "sample_time", 0x06: "group_counter", 0x01: "error"}
    known = vectors(shared_data)
    assert len(known) == 10
    for vector in known:
        counts = decode(DataId(vector["can_id"]), bytes.fromhex(vector["hex"]))
        if vector["id"] == "xcdi-neg-dlc":
            assert isinstance(counts, CorruptBytes)
        elif vector["can_id"] in names:
            assert counts == (vector["decoded"][names[vector["can_id"]]],)
        elif vector["valid"]:
            assert list(counts) == vector["decoded"]["raw"]


MESSAGES = {
    DataId.ERROR: st.tuples(st.integers(0, 255)),
    DataId.SAMPLE_TIME: st.tuples(st.integers(0, 2**32 - 1)),
    DataId.GROUP_COUNTER: st.tuples(st.integers(0, 2**16 - 1)),
    DataId.STATUS_WORD: st.tuples(st.integers(0, 2**32 - 1)),
    DataId.QUATERNION: quaternions,
    DataId.EULER: st.tuples(shorts, shorts, shorts),
    DataId.RATE_OF_TURN: st.tuples(shorts, shorts, shorts),
    DataId.ACCELERATION: st.tuples(shorts, shorts, shorts),
}


@pytest.mark.parametrize("data_id", MESSAGES)
def test_an_independent_reader_agrees(shared_data: Path, data_id: DataId) -> None:
    oracle = cantools.database.load_file(shared_data / "imu" / "dbc" / "xsens_mti_xcdi.dbc")
    assert isinstance(oracle, cantools.database.Database)
    # The DBC file assumes ticks of 100 us for SampleTime.
    scale = 0.0001 if data_id is DataId.SAMPLE_TIME else layout(data_id).scale

    @given(MESSAGES[data_id])
    def agree(counts: tuple[int, ...]) -> None:
        wire = encode(data_id, counts)
        theirs = oracle.decode_message(int(data_id), wire)
        assert isinstance(theirs, dict)
        assert decode(data_id, wire) == counts
        for their, our in zip(theirs.values(), counts, strict=True):
            assert isinstance(their, (int, float))
            assert isclose(their, our * scale, rel_tol=1e-9, abs_tol=1e-9)

    agree()


@given(st.sampled_from(list(DataId)), st.binary(max_size=8))
def test_any_bytes_are_counts_or_corrupt(data_id: DataId, data: bytes) -> None:
    for byte_order in ("big", "little"):
        counts = decode(data_id, data, byte_order)
        if not isinstance(counts, CorruptBytes):
            assert encode(data_id, counts, byte_order) == data


def test_messages_have_the_identifiers_sizes_and_scales_of_the_manual() -> None:
    assert [kind.value for kind in DataId] == list(SIZES)
    for number, size in SIZES.items():
        for length in range(9):
            found = decode(DataId(number), bytes(length))
            assert isinstance(found, CorruptBytes) == (length != size)
    scales = {DataId.QUATERNION: 1 / 32767, DataId.EULER: 1 / 128, DataId.RATE_OF_TURN: 1 / 512,
              DataId.ACCELERATION: 1 / 256, DataId.FREE_ACCELERATION: 1 / 256}  # fmt: skip
    for kind in DataId:
        assert layout(kind).scale == scales.get(kind, 1)
    wire = encode(DataId.UTC, (26, 11, 29, 1, 2, 3, 9999))
    assert wire.hex() == "1a0b1d010203" + "270f"
    assert encode(DataId.SAMPLE_TIME, (258,), "little").hex() == "02010000"


def test_a_block_moves_every_identifier() -> None:
    assert XcdiIds() == (0x05, 0x06, 0x21, 0x11, 0x01, False)
    assert id_block(0x100) == (0x105, 0x106, 0x121, 0x111, 0x101, False)
    assert id_block(0x800, extended=True) == (0x805, 0x806, 0x821, 0x811, 0x801, True)
    long = XcdiIds(0x7FF, None, 0x800, None, None)
    assert long.by_id() == {(0x7FF, False): DataId.SAMPLE_TIME, (0x800, True): DataId.QUATERNION}


def test_counts_beyond_full_scale_are_clipped() -> None:
    assert quaternion_counts((1.1, -1.1, 1.00002, -1.00003)) == (32767, -32768, 32767, -32768)


def test_an_open_group_is_discarded_by_a_flush() -> None:
    decoder = XcdiCodec(XcdiIds())
    groups_of(decoder, group(0, XcdiIds())[:1])
    decoder.flush()
    assert decoder.incomplete == 1
    decoder.flush()
    assert decoder.incomplete == 1
    remote = CanFrame(0, 0x21, b"", remote=True)
    assert decoder.feed(remote) is None
    assert (decoder.foreign, decoder.messages) == (1, 1)


def test_full_scale_is_rounded_not_overflowed() -> None:
    assert quaternion_counts((1.0, -1.0, 0.5, 0.0)) == (32767, -32767, 16384, 0)


def group(number: int, ids: XcdiIds, t_ns: int = 0) -> list[CanFrame]:
    extended = ids.extended
    assert ids.sample_time is not None
    assert ids.group_counter is not None
    return [
        CanFrame(t_ns, ids.sample_time, encode(DataId.SAMPLE_TIME, (100 * number,)), extended),
        CanFrame(t_ns + 1, ids.group_counter, encode(DataId.GROUP_COUNTER, (number,)), extended),
        CanFrame(t_ns + 2, ids.quaternion, encode(DataId.QUATERNION, (32767, 0, 0, 0)), extended),
    ]


def groups_of(decoder: XcdiCodec, frames: list[CanFrame]) -> list[XcdiGroup]:
    return [item for item in map(decoder.feed, frames) if isinstance(item, XcdiGroup)]


def test_a_group_is_stamped_with_its_first_frame() -> None:
    decoder = XcdiCodec(XcdiIds())
    (found,) = groups_of(decoder, group(7, XcdiIds(), 1000))
    assert found == XcdiGroup(1000, 700, 7, None, (32767, 0, 0, 0))


@given(st.integers(0, 2**32 - 1))
def test_sensors_interleave_freely(seed: int) -> None:
    order = random.Random(seed)
    sensors = [id_block(0x100), id_block(0x200), id_block(0x18FF0000, extended=True)]
    queues = [[f for n in range(20) for f in group(n, ids)] for ids in sensors]
    mixed = []
    while any(queues):
        mixed.append(order.choice([queue for queue in queues if queue]).pop(0))
    for ids in sensors:
        decoder = XcdiCodec(ids)
        found = groups_of(decoder, mixed)
        assert [(each.ticks, each.counter) for each in found] == [(100 * n, n) for n in range(20)]
        assert (decoder.messages, decoder.foreign, decoder.incomplete) == (60, 120, 0)


def test_a_lost_quaternion_is_an_incomplete_group() -> None:
    decoder = XcdiCodec(XcdiIds())
    frames = group(0, XcdiIds())[:2] + group(1, XcdiIds())
    assert [each.counter for each in groups_of(decoder, frames)] == [1]
    assert decoder.incomplete == 1


def test_a_quaternion_without_sample_time_has_its_own_stamp_and_no_ticks() -> None:
    decoder = XcdiCodec(XcdiIds())
    (found,) = groups_of(decoder, group(3, XcdiIds(), 1000)[1:])
    assert found == XcdiGroup(1002, None, 3, None, (32767, 0, 0, 0))
    assert decoder.ungrouped == 1


def test_new_counter_is_not_combined_with_an_older_time() -> None:
    decoder = XcdiCodec(XcdiIds())
    frames = group(0, XcdiIds())[:2] + group(1, XcdiIds())[1:]
    (found,) = groups_of(decoder, frames)
    assert (found.ticks, found.counter) == (None, 1)
    assert decoder.incomplete == 1


def test_status_belongs_to_its_group() -> None:
    decoder = XcdiCodec(XcdiIds())
    frames = group(0, XcdiIds())
    frames.insert(2, CanFrame(0, 0x11, encode(DataId.STATUS_WORD, (2,))))
    assert [g.status for g in groups_of(decoder, frames + group(1, XcdiIds()))] == [2, None]


def test_xcdi_error_message_is_reported() -> None:
    assert XcdiCodec(XcdiIds()).feed(CanFrame(5, 1, b"\1")) == XcdiError(5, 1)


def test_11_and_29_bit_identifiers_are_different() -> None:
    decoder = XcdiCodec(XcdiIds())
    assert not groups_of(decoder, group(0, XcdiIds(extended=True)))
    assert decoder.foreign == 3


@given(st.lists(can_frames))
def test_any_frames_give_groups_and_every_frame_is_accounted_for(frames: list[CanFrame]) -> None:
    decoder = XcdiCodec(XcdiIds())
    found = [decoder.feed(frame) for frame in frames]
    corrupt = sum(isinstance(item, CorruptBytes) for item in found)
    assert decoder.messages + decoder.foreign + corrupt == len(frames)


def decided(
    tick_ns: int,
    rate_hz: float = 100.0,
    count: int = 11,
    configured_hz: float | None = None,
    since_ns: int = 0,
) -> int | None:
    unit, answer = TickUnit(configured_hz or rate_hz), None
    for n in range(count):
        at = round(n * 1e9 / rate_hz)
        answer = unit.feed((2**32 - 500 + round(at / tick_ns)) % 2**32, n, since_ns + at)
    return answer


def test_the_unit_shows_after_ten_steps_even_over_a_wrap() -> None:
    for tick_ns in (1_000, 100_000):
        assert decided(tick_ns, count=10) is None
        assert decided(tick_ns, count=11) == tick_ns


@given(st.lists(st.integers(0, 10**9), min_size=30, max_size=30), st.sampled_from([1000, 100_000]))
def test_no_delay_of_the_arrivals_hides_the_unit(delays_ns: list[int], tick_ns: int) -> None:
    unit, arrival, answer = TickUnit(100.0), 0, None
    for n, delay in enumerate(delays_ns):
        arrival = max(arrival + 1000, n * 10_000_000 + delay)
        answer = unit.feed(n * 10_000_000 // tick_ns, n, arrival)
    assert answer == tick_ns


@pytest.mark.parametrize("tick_ns", [1_000, 100_000])
def test_lost_groups_do_not_hide_the_unit_if_there_is_a_counter(tick_ns: int) -> None:
    unit, answer = TickUnit(100.0), None
    for n in range(0, 400, 20):  # one group in twenty arrives
        answer = unit.feed(n * 10_000_000 // tick_ns, n, n * 10_000_000)
    assert answer == tick_ns


def test_arrivals_over_two_seconds_correct_a_unit_that_a_wrong_rate_gave() -> None:
    assert decided(100_000, rate_hz=10.0, count=15, configured_hz=1000.0) == 1_000
    assert decided(100_000, rate_hz=10.0, count=25, configured_hz=1000.0) == 100_000


def test_a_host_that_has_run_for_long_corrects_the_unit_as_fast() -> None:
    month_ns = 30 * 86_400 * 10**9
    for count, tick_ns in ((15, 1_000), (25, 100_000)):
        found = decided(100_000, 10.0, count, configured_hz=1000.0, since_ns=month_ns)
        assert found == tick_ns


def test_a_sample_time_that_stands_still_has_no_unit() -> None:
    unit = TickUnit(100.0)
    assert {unit.feed(7, n, n * 10_000_000) for n in range(300)} == {None}
    assert unit.ticks_per_s is None


def test_a_clock_of_another_kind_is_not_forced_into_either_unit() -> None:
    assert decided(10_000, count=250) is None
