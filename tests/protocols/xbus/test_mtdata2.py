"""MTData2 items survive a round trip, and recorded messages have the expected values."""

from __future__ import annotations

import json
import math
import struct
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_protocols.orientation import canonical
from jointfit_protocols.xbus import XbusCodec, XbusMessage, mtdata2
from jointfit_protocols.xbus.mtdata2 import Item, Precision, Trigger, UtcTime

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data" / "imu"
VECTORS: list[dict[str, Any]] = (
    [
        entry
        for entry in json.loads((SHARED / "vectors.json").read_text(encoding="utf-8"))
        if entry["id"].startswith(("xbus-mt2", "xbus-real"))
    ]
    if SHARED.is_dir()
    else []
)

REALS = {
    Item.QUATERNION: 4,
    Item.ROTATION_MATRIX: 9,
    Item.EULER_ANGLES: 3,
    Item.DELTA_V: 3,
    Item.ACCELERATION: 3,
    Item.FREE_ACCELERATION: 3,
    Item.RATE_OF_TURN: 3,
    Item.DELTA_Q: 4,
    Item.MAGNETIC_FIELD: 3,
}
COUNTS = {
    Item.PACKET_COUNTER: 16,
    Item.SAMPLE_TIME_FINE: 32,
    Item.SAMPLE_TIME_COARSE: 32,
    Item.STATUS_BYTE: 8,
    Item.STATUS_WORD: 32,
}
STEP = {
    Precision.FLOAT32: 2e-4,
    Precision.FIXED_12_20: 2**-20,
    Precision.FIXED_16_32: 2**-32,
    Precision.FLOAT64: 0.0,
}


def messages(shared_data: Path, number: str) -> list[dict[int, bytes]]:
    decoder = XbusCodec()
    wire = (shared_data / "imu" / "xsens" / f"{number}.output.bin").read_bytes()
    found = []
    for event in decoder.feed(wire):
        assert isinstance(event, XbusMessage)
        items = mtdata2.split(event.data)
        assert items is not None
        found.append(dict(items))
    return found


def value(items: dict[int, bytes], data_id: int) -> Any:
    return mtdata2.decode_item(data_id, items[data_id])


@given(st.data(), st.sampled_from(sorted(REALS)), st.sampled_from(Precision))
def test_reals_come_back_within_half_a_step(
    data: st.DataObject, item: Item, precision: Precision
) -> None:
    world: Any = data.draw(st.sampled_from(["ENU", "NED", "NWU"]))
    count = REALS[item]
    numbers = data.draw(st.lists(st.floats(-2047, 2047), min_size=count, max_size=count).map(tuple))
    data_id = mtdata2.real_id(item, precision, world)
    wire = mtdata2.encode_item(data_id, numbers)
    assert mtdata2.world_of(data_id) == world
    ((found_id, raw),) = mtdata2.split(wire) or []
    back = mtdata2.decode_item(found_id, raw)
    assert back == pytest.approx(numbers, abs=STEP[precision])
    assert mtdata2.encode_item(data_id, back or ()) == wire


@given(st.data(), st.sampled_from(sorted(COUNTS)))
def test_counts_survive_a_round_trip(data: st.DataObject, item: Item) -> None:
    number = data.draw(st.integers(0, 2 ** COUNTS[item] - 1))
    wire = mtdata2.encode_item(item, number)
    assert mtdata2.decode_item(item, wire[3:]) == number


@given(
    st.builds(
        Trigger,
        st.integers(0, 255),
        st.integers(0, 3),
        st.integers(0, 2**32 - 1),
        st.integers(0, 2**16 - 1),
    )
)
def test_edges_survive_a_round_trip(edge: Trigger) -> None:
    wire = mtdata2.encode_item(Item.TRIGGER_IN1, edge)
    assert wire[:3] == b"\x48\x10\x08"
    assert mtdata2.decode_item(Item.TRIGGER_IN1, wire[3:]) == edge
    assert mtdata2.decode_item(Item.TRIGGER_IN1, wire[3:-1]) is None


def test_every_item_is_known_to_the_codec() -> None:
    other = {Item.UTC_TIME, Item.GNSS_PVT, Item.TRIGGER_IN1, Item.TRIGGER_IN2}
    assert set(REALS) | set(COUNTS) | other == set(Item)


def test_identifiers_are_those_of_the_manual() -> None:
    assert [item.value for item in Item] == [
        0x1010, 0x1020, 0x1060, 0x1070, 0x2010, 0x2020, 0x2030, 0x4010, 0x4020, 0x4030, 0x4810,
        0x4820, 0x7010, 0x8020, 0x8030, 0xC020, 0xE010, 0xE020,
    ]  # fmt: skip
    families = {
        0x08: (0x10,), 0x10: (0x10, 0x20, 0x30, 0x40, 0x50, 0x60, 0x70), 0x20: (0x10, 0x20, 0x30),
        0x30: (0x10,), 0x40: (0x10, 0x20, 0x30, 0x40), 0x48: (0x10, 0x20), 0x50: (0x20, 0x30, 0x40),
        0x70: (0x10, 0x20, 0x30), 0x80: (0x20, 0x30, 0x40), 0x88: (0x30, 0x40, 0x80, 0xA0),
        0xA0: (0x10, 0x20), 0xB0: (0x10, 0x20), 0xC0: (0x20,), 0xD0: (0x10,),
        0xE0: (0x10, 0x20, 0x40, 0x80, 0x90),
    }  # fmt: skip
    assert {group << 8 | kind for group, kinds in families.items() for kind in kinds} == set(
        mtdata2.KNOWN_ITEMS
    )
    assert (mtdata2.FILTER_VALID, mtdata2.CLIPPING) == (0x2, 0x8_0000)


def test_the_low_bits_of_an_identifier_are_precision_and_world() -> None:
    assert mtdata2.real_id(Item.QUATERNION) == 0x2010
    assert mtdata2.real_id(Item.QUATERNION, Precision.FIXED_12_20, "NED") == 0x2015
    assert mtdata2.real_id(Item.QUATERNION, Precision.FIXED_16_32, "NWU") == 0x201A
    assert mtdata2.real_id(Item.QUATERNION, Precision.FLOAT64) == 0x2013
    assert mtdata2.world_of(0x201C) is None
    assert mtdata2.decode_item(0x201C, bytes(16)) is None
    assert (mtdata2.reals_in(0x2025), mtdata2.reals_in(0x202C)) == (9, None)
    assert mtdata2.reals_in(Item.PACKET_COUNTER) is None


def test_counts_and_positions_have_the_documented_sizes() -> None:
    sizes = {Item.PACKET_COUNTER: 2, Item.SAMPLE_TIME_FINE: 4, Item.SAMPLE_TIME_COARSE: 4,
             Item.STATUS_BYTE: 1, Item.STATUS_WORD: 4, Item.UTC_TIME: 12, Item.TRIGGER_IN2: 8,
             Item.GNSS_PVT: 94}  # fmt: skip
    for item, size in sizes.items():
        assert mtdata2.decode_item(item, bytes(size)) is not None
        assert mtdata2.decode_item(item, bytes(size - 1)) is None
        assert mtdata2.decode_item(item, bytes(size + 1)) is None


def test_utc_time_survives_a_round_trip() -> None:
    time = UtcTime(123_456_789, 2019, 1, 20, 17, 2, 3, 7)
    wire = mtdata2.encode_item(Item.UTC_TIME, time)
    assert mtdata2.decode_item(Item.UTC_TIME, wire[3:]) == time


@given(st.integers(0, 0xFFFF), st.binary(max_size=120))
def test_decoding_any_item_does_not_raise(data_id: int, raw: bytes) -> None:
    mtdata2.decode_item(data_id, raw)


@given(st.sampled_from(sorted(REALS)), st.sampled_from(Precision), st.binary(max_size=80))
def test_an_item_of_the_wrong_size_has_no_value(
    item: Item, precision: Precision, raw: bytes
) -> None:
    size = (4, 4, 6, 8)[precision] * REALS[item]
    got = mtdata2.decode_item(mtdata2.real_id(item, precision), raw)
    assert (got is None) == (len(raw) != size)


@given(st.lists(st.tuples(st.integers(0, 0xFFFF), st.binary(max_size=20))))
def test_unknown_items_are_kept_by_size(items: list[tuple[int, bytes]]) -> None:
    assert mtdata2.split(mtdata2.encode_items(items)) == items


@given(st.lists(st.tuples(st.integers(0, 0xFFFF), st.binary(max_size=9)), min_size=1), st.data())
def test_a_run_that_does_not_end_exactly_is_refused(
    items: list[tuple[int, bytes]], data: st.DataObject
) -> None:
    """A run is the sequence of items in a message."""
    wire = mtdata2.encode_items(items)
    lengths = [3 + len(raw) for _, raw in items]
    ends = {sum(lengths[:count]) for count in range(len(items) + 1)}
    short = data.draw(st.integers(0, len(wire)))
    assert (mtdata2.split(wire[:short]) is None) == (short not in ends)


@given(st.floats(-2047, 2047))
def test_12_20_is_an_integer_over_2_to_the_20(number: float) -> None:
    """The format 12.20 is a fixed-point number with 20 bits after the point."""
    raw = mtdata2.encode_reals(Precision.FIXED_12_20, [number])
    assert struct.unpack(">i", raw)[0] == round(number * 2**20)


def test_16_32_holds_its_fraction_before_its_whole_part() -> None:
    """The format 16.32 is a fixed-point number with 32 bits after the point."""
    raw = mtdata2.encode_reals(Precision.FIXED_16_32, [-0.5, 3.25])
    assert raw.hex() == "80000000ffff" + "400000000003"


def test_a_value_outside_the_encoding_is_a_bug_of_the_caller() -> None:
    with pytest.raises((struct.error, OverflowError)):
        mtdata2.encode_reals(Precision.FIXED_12_20, [5000.0])


@pytest.mark.skipif(not VECTORS, reason="vectors.json is not here")
@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["id"])
def test_vector(vector: dict[str, Any]) -> None:
    (message,) = XbusCodec().feed(bytes.fromhex(vector["hex"]))
    assert isinstance(message, XbusMessage)
    items = dict(mtdata2.split(message.data) or [])
    expected = vector["decoded"]
    assert value(items, Item.PACKET_COUNTER) == expected["packet_counter"]
    assert value(items, Item.SAMPLE_TIME_FINE) == expected["sample_time_fine"]
    ids = [data_id for data_id in items if data_id & 0xFFF0 == Item.QUATERNION]
    if expected["native_wxyz"] is None:
        assert ids == []
        return
    native = value(items, ids[0])
    world = mtdata2.world_of(ids[0])
    assert world == expected["native_world"]
    assert native == pytest.approx(expected["native_wxyz"], abs=1e-7)
    assert world is not None
    got = np.array(canonical(native, world), dtype=np.float64)
    assert got / np.linalg.norm(got) == pytest.approx(expected["canonical_wxyz"], abs=5e-7)


STEPS = {
    "1": {100: 91, -419: 4, 519: 4},
    "3": {100: 91, -418: 3, 518: 3, -518: 1, 618: 1},
    "5": {100: 88, -514: 2, 614: 2, -414: 2, 514: 2, 0: 2, 50: 1},
}
COUNT = {  # numbers of items: Euler angles, delta q, matrix, quaternion, PVT
    "1": (95, 96, 0, 0, 4),
    "3": (95, 96, 0, 0, 4),
    "5": (0, 0, 92, 92, 3),
}
FIRST = {"1": (43398, 51703123), "3": (43598, 51725422), "5": (43798, 51747668)}


@pytest.mark.parametrize("number", ["1", "3", "5"])
def test_a_recording_holds_the_expected_items(shared_data: Path, number: str) -> None:
    found = messages(shared_data, number)
    times = [value(items, Item.SAMPLE_TIME_FINE) for items in found]
    counters = [value(items, Item.PACKET_COUNTER) for items in found]
    assert (counters[0], times[0]) == FIRST[number]
    assert np.diff(counters).tolist() == [1] * 99
    assert Counter(np.diff(times).tolist()) == STEPS[number]
    kinds = Counter(
        data_id & 0xFFF0
        for items in found
        for data_id in items
        if mtdata2.decode_item(data_id, items[data_id]) is not None
    )
    wanted = (
        Item.EULER_ANGLES, Item.DELTA_Q, Item.ROTATION_MATRIX, Item.QUATERNION, Item.GNSS_PVT,
    )  # fmt: skip
    assert tuple(kinds[item] for item in wanted) == COUNT[number]


def test_the_matrix_sent_is_the_rotation_of_the_quaternion_column_by_column(
    shared_data: Path,
) -> None:
    checked = 0
    for items in messages(shared_data, "5"):
        if Item.QUATERNION not in items:
            continue
        w, x, y, z = value(items, Item.QUATERNION)
        matrix = np.array(value(items, Item.ROTATION_MATRIX)).reshape(3, 3).T
        expected = Rotation.from_quat([x, y, z, w]).as_matrix()
        assert np.abs(matrix - expected).max() < 4e-7
        checked += 1
    assert checked == 92


def test_recorded_quaternions_have_norm_1(shared_data: Path) -> None:
    norms = [
        math.hypot(*value(items, Item.QUATERNION))
        for items in messages(shared_data, "5")
        if Item.QUATERNION in items
    ]
    assert len(norms) == 92
    assert max(abs(norm - 1) for norm in norms) < 2e-7
