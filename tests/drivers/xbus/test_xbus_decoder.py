"""The decoder of the Xbus driver: samples, stamps, gaps, restarts and checks."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from jointfit_daemon.model import Chunk, Corrupt, DeviceEvent, ImuSample
from jointfit_drivers.xbus import XbusDecoder
from jointfit_drivers.xbus._continuity import XbusContinuity, XbusStep
from jointfit_protocols.xbus import XbusMessageId, encode
from jointfit_protocols.xbus import configuration as setup
from jointfit_protocols.xbus.mtdata2 import Item, encode_items

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded

BYTE_NS = 86_805.5556  # ten bits at 115200 baud
SHARED = Path(__file__).resolve().parents[4] / "shared" / "data" / "imu"
IDENTITY = (1.0, 0.0, 0.0, 0.0)


def decoder() -> XbusDecoder:
    return XbusDecoder(115_200, 100.0)


def message(counter: int, ticks: int, q: tuple[float, ...] | None = IDENTITY) -> bytes:
    items: list[tuple[int, Any]] = [(Item.PACKET_COUNTER, counter), (Item.SAMPLE_TIME_FINE, ticks)]
    if q is not None:
        items.append((Item.QUATERNION, q))
    return encode(XbusMessageId.MT_DATA2, encode_items(items))


def fed(events: XbusDecoder, *wires: bytes) -> list[Decoded]:
    return [event for wire in wires for event in events.feed(Chunk(0, wire))]


def told(events: list[Decoded]) -> list[tuple[str, dict[str, object]]]:
    return [(event.kind, dict(event.data)) for event in events if isinstance(event, DeviceEvent)]


def samples(events: list[Decoded]) -> list[ImuSample]:
    return [event for event in events if isinstance(event, ImuSample)]


@pytest.mark.parametrize("size", [1, 36, 1000, 100_000])
def test_the_recording_gives_92_samples_no_gap_and_no_restart(shared_data: Path, size: int) -> None:
    wire = (shared_data / "imu" / "xsens" / "5.output.bin").read_bytes()
    events = fed(decoder(), *(wire[at : at + size] for at in range(0, len(wire), size)))
    found = samples(events)
    assert len(events) == len(found) == 92
    assert (found[0].ticks, found[0].counter) == (51747818, 43800)
    assert found[0].q_native == (
        0.0038471566513180733, -0.003237534314393997, -0.764083743095398, 0.6450973749160767,
    )  # fmt: skip
    assert (found[-1].ticks, found[-1].counter) == (51756918, 43897)
    for sample in found:
        assert math.hypot(*sample.q_world_sensor) == pytest.approx(1.0, abs=1e-12)


def test_every_vector_with_an_orientation_gives_the_canonical_one(shared_data: Path) -> None:
    vectors = json.loads((shared_data / "imu" / "vectors.json").read_text(encoding="utf-8"))
    checked = 0
    for vector in vectors:
        canonical = vector.get("decoded", {}).get("canonical_wxyz")
        if vector["protocol"] != "xsens-xbus" or canonical is None:
            continue
        (sample,) = samples(fed(decoder(), bytes.fromhex(vector["hex"])))
        dot = sum(a * b for a, b in zip(sample.q_world_sensor, canonical, strict=True))
        assert abs(dot) == pytest.approx(1.0, abs=1e-6)
        checked += 1
    assert checked == 11


@given(st.lists(st.binary(max_size=60) | st.just(message(1, 2)), max_size=10))
def test_any_bytes_give_events_and_every_lost_byte_is_counted(wires: list[bytes]) -> None:
    events = decoder()
    found = fed(events, *wires) + events.flush()
    lost = sum(event.discarded for event in found if isinstance(event, Corrupt))
    assert lost == events.discarded_bytes <= sum(map(len, wires))


@given(st.binary(max_size=80))
def test_any_data_in_any_message_gives_events(data: bytes) -> None:
    for mid in XbusMessageId:
        fed(decoder(), encode(mid, data))


def test_a_sample_is_stamped_with_the_arrival_of_its_first_byte() -> None:
    wire = message(1, 100) + message(2, 200)
    found = samples(decoder().feed(Chunk(10**9, wire + b"\xfa\xff")))
    assert found[1].arrival_ns == pytest.approx(10**9 - 38 * BYTE_NS, abs=2)
    assert found[0].arrival_ns == pytest.approx(10**9 - 74 * BYTE_NS, abs=2)


def test_a_message_in_two_chunks_is_stamped_by_the_one_that_completes_it() -> None:
    events, wire = decoder(), message(1, 100)
    assert events.feed(Chunk(10**9, wire[:20])) == []
    (sample,) = samples(events.feed(Chunk(10**9 + 5_000_000, wire[20:])))
    assert sample.arrival_ns == pytest.approx(10**9 + 5_000_000 - 36 * BYTE_NS, abs=2)


def test_arrivals_never_run_backwards_on_a_line_faster_than_its_speed() -> None:
    events = decoder()
    first = samples(events.feed(Chunk(10**9, message(1, 100))))
    more = samples(events.feed(Chunk(10**9 + 1000, message(2, 200) + message(3, 300))))
    assert first[0].arrival_ns <= more[0].arrival_ns <= more[1].arrival_ns


def test_incomplete_message_is_dropped_after_a_silence() -> None:
    events = decoder()
    events.feed(Chunk(0, bytes.fromhex("faff36ff07d0")))  # the codec then waits for 2000 bytes
    found = events.feed(Chunk(300_000_000, message(1, 100)))
    assert [type(event) for event in found] == [Corrupt, ImuSample]


def test_a_stalled_host_is_no_silent_line() -> None:
    """The rest of a message is accepted although the host reads it 200 ms late."""
    events, wire = XbusDecoder(921_600, 100.0), message(1, 100)
    events.feed(Chunk(0, wire[:20]))
    assert len(samples(events.feed(Chunk(200_000_000, wire[20:])))) == 1


def test_lost_messages_are_a_gap_with_their_number() -> None:
    events = fed(decoder(), message(1, 100), message(2, 200), message(6, 600))
    assert told(events) == [("gap", {"lost": 3})]
    assert len(samples(events)) == 3


def test_messages_without_an_orientation_take_counters_and_no_time() -> None:
    """They increase the packet counter, and their time is that of another clock."""
    events = fed(
        decoder(), message(1, 100), message(2, 99_000, None), message(3, 200),
        message(4, 3, None), message(6, 300),
    )  # fmt: skip
    assert told(events) == [("gap", {"lost": 1})]


def test_the_counter_wraps() -> None:
    events = fed(decoder(), message(65534, 100), message(65535, 200), message(0, 300))
    assert told(events) == []


@pytest.mark.parametrize(
    ("product", "modulus"), [("MTi-3-8A7G6", 2**32), ("MTi-300", 864_000_000), (None, None)]
)
def test_clock_wraps_at_the_limit_of_the_model_or_at_the_observed_one(
    product: str | None, modulus: int | None
) -> None:
    """Depending on the model, the clock wraps at 2^32 ticks or after 24 hours."""
    for turn in (2**32, 864_000_000) if modulus is None else (modulus,):
        events = decoder()
        if product is not None:
            fed(events, encode(XbusMessageId.PRODUCT_CODE, product.encode()))
            assert events.tick_clock.modulus == turn
        found = fed(events, message(1, turn - 150), message(2, turn - 50), message(3, 50))
        assert told(found) == []
        assert events.tick_clock.modulus == turn


def test_time_that_falls_is_a_restart_and_no_gap() -> None:
    events = fed(
        decoder(), message(500, 70_000), message(501, 70_100), message(0, 100), message(1, 200)
    )
    assert [kind for kind, _ in told(events)] == ["restart"]
    assert [one.counter for one in samples(events)] == [500, 501, 0, 1]


def test_stale_messages_before_fresh_ones_are_a_gap_in_the_same_clock() -> None:
    """Counter and time have advanced by the same number of samples."""
    events = fed(decoder(), message(10, 1_000), message(11, 1_100), message(6_011, 601_100))
    assert told(events) == [("gap", {"lost": 5999})]


def test_time_that_leaps_without_the_counter_is_a_restart() -> None:
    events = fed(
        decoder(),
        message(10, 1_000),
        message(11, 1_100),
        message(12, 601_100),
        message(13, 601_200),
    )
    assert [kind for kind, _ in told(events)] == ["restart"]


def test_a_wake_up_is_a_restart_only_after_measurements() -> None:
    wake = encode(XbusMessageId.WAKE_UP)
    assert told(fed(decoder(), wake, message(1, 100))) == []
    events = fed(decoder(), message(900, 90_000), wake, message(0, 100), message(1, 200))
    assert [kind for kind, _ in told(events)] == ["restart"]


@given(st.integers(0, 65535), st.integers(0, 2**31), st.lists(st.integers(0, 400), max_size=60))
def test_any_losses_are_counted_exactly(counter: int, ticks: int, losses: list[int]) -> None:
    follow = XbusContinuity(100.0)
    assert follow.orientation(counter, ticks, 0) == XbusStep()
    for lost in losses:
        counter, ticks = (counter + lost + 1) % 65536, ticks + 100 * (lost + 1)
        assert follow.orientation(counter, ticks, 0) == XbusStep(lost)


@given(st.integers(0, 10_000), st.integers(13_000, 2**31))
@example(0, 830_562_750)  # 56 minutes before a day clock wraps, but no time has passed
def test_clock_reset_is_a_restart_after_a_second_message(after: int, before: int) -> None:
    follow = XbusContinuity(100.0)
    ticks = (before - 100, before, after, after + 100)
    steps = [follow.orientation(counter, at, 0) for counter, at in enumerate(ticks)]
    assert [step.restarted for step in steps] == [False, False, False, True]
    assert steps[2].held
    assert steps[3].confirmed


def test_a_device_at_another_rate_than_asked_does_not_restart() -> None:
    follow = XbusContinuity(100.0)
    for number in range(100):
        assert not follow.orientation(number, 200 * number, 0).restarted
    assert follow.orientation(1099, 200 * 1099, 0) == XbusStep(999)


def test_time_that_stands_still_and_goes_on_is_no_bug() -> None:
    wires = [message(number, 1_000) for number in range(30)]
    wires += [message(30 + number, 1_000 + 100 * number) for number in range(30)]
    events = fed(decoder(), *wires)
    assert told(events) == []
    assert len(samples(events)) == 60


@pytest.mark.parametrize(
    ("counter", "ticks"), [(7 | 1 << 15, 700), (7, 700 | 1 << 20), (12, 700), (9_000, 2**31)]
)
def test_one_damaged_message_is_no_gap_and_no_restart(counter: int, ticks: int) -> None:
    wires = [message(number, 100 * number) for number in range(1, 20)]
    wires[6] = message(counter, ticks)
    events = fed(decoder(), *wires)
    assert told(events) in ([], [("gap", {"lost": 1})], [("gap", {"lost": 5})])
    assert len(samples(events)) >= 18
    assert [event.discarded for event in events if isinstance(event, Corrupt)] in (
        [], [len(wires[6])],
    )  # fmt: skip


def test_a_damaged_first_message_is_no_restart() -> None:
    wires = [message(number, 100 * number) for number in range(1, 20)]
    wires[0] = message(40_000, 3_000_000_000)
    events = fed(decoder(), *wires)
    assert told(events) == []
    assert len(samples(events)) == 19


def test_a_counter_that_begins_again_alone_is_neither_a_loss_nor_a_restart() -> None:
    wires = [message(number, 100 * number) for number in range(1, 20)]
    wires += [message(number - 19, 100 * number) for number in range(20, 40)]
    events = fed(decoder(), *wires)
    assert told(events) == [("counter", {})]
    assert len(samples(events)) == 39


def test_a_counter_jump_is_reported_where_it_was_and_names_the_new_value() -> None:
    wires = [message(number, 100 * number) for number in range(1, 20)]
    wires += [message(number + 500, 100 * number) for number in range(20, 22)]
    follow = decoder()
    assert told(fed(follow, *wires[:-1])) == []
    jumped, *went_on = fed(follow, wires[-1])
    assert jumped == DeviceEvent("counter", "packet counter jumped to 520, device time did not")
    assert [sample.counter for sample in samples(went_on)] == [520, 521]


def test_a_gap_of_hours_is_counted_whole() -> None:
    wires = [message(number, 100 * number) for number in range(20)]
    wires += [message((100_000 + number) % 65536, 100 * (100_000 + number)) for number in range(2)]
    assert told(fed(decoder(), *wires)) == [("gap", {"lost": 99_980})]


def test_a_wake_up_with_data_is_a_damaged_measurement() -> None:
    events = fed(
        decoder(), message(1, 100), encode(XbusMessageId.WAKE_UP, bytes(20)), message(2, 200)
    )
    assert told(events) == []


@given(st.lists(st.tuples(st.none() | st.integers(0, 65535), st.none() | st.integers(0, 2**32))))
def test_any_counters_and_times_are_accepted(steps: list[tuple[int | None, int | None]]) -> None:
    follow = XbusContinuity(100.0)
    held = False
    for counter, ticks in steps:
        step = follow.orientation(counter, ticks, 0)
        assert 0 <= step.lost <= 2**32 // 50
        assert not step.confirmed or held
        held = step.held


def test_a_quaternion_of_another_norm_is_refused() -> None:
    events = decoder()
    found = fed(events, message(1, 100, (0.5, 0.0, 0.0, 0.0)))
    assert found == [Corrupt(36, "quaternion norm is not 1", rejected=1)]
    assert (events.messages, events.discarded_bytes) == (0, 36)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_quaternion_that_is_no_number_is_refused(bad: float) -> None:
    assert samples(fed(decoder(), message(1, 100, (bad, 0.0, 0.0, 0.0)))) == []


def test_wrong_scale_is_reported_once_with_the_measured_norm() -> None:
    events = fed(decoder(), *(message(n, 100 * n, (0.25, 0.0, 0.0, 0.0)) for n in range(300)))
    assert told(events) == [("warning", {"median_norm": 0.25})]
    nothing = (math.nan, 0.0, 0.0, 0.0)
    events = fed(decoder(), *(message(n, 100 * n, nothing) for n in range(300)))
    assert told(events) == [("warning", {})]


def test_items_that_do_not_fill_the_message_make_it_corrupt() -> None:
    events = decoder()
    wire = encode(XbusMessageId.MT_DATA2, encode_items([(Item.PACKET_COUNTER, 1)]) + b"\x20\x10")
    (found,) = fed(events, wire)
    assert isinstance(found, Corrupt)
    assert found.discarded == len(wire) == events.discarded_bytes


def test_a_quaternion_of_the_wrong_size_makes_it_corrupt() -> None:
    wire = encode(XbusMessageId.MT_DATA2, encode_items([(Item.QUATERNION, bytes(12))]))
    (found,) = fed(decoder(), wire)
    assert isinstance(found, Corrupt)


def test_quaternion_sign_is_continuous() -> None:
    q = (0.5, 0.5, 0.5, 0.5)
    found = samples(fed(decoder(), message(1, 100, q), message(2, 200, tuple(-x for x in q))))
    assert found[0].q_world_sensor == pytest.approx(found[1].q_world_sensor)
    assert found[1].q_native == tuple(-x for x in q)


def test_device_description_is_reported_as_information() -> None:
    found = fed(
        decoder(),
        encode(XbusMessageId.DEVICE_ID, bytes.fromhex("0360a1b2")),
        encode(XbusMessageId.PRODUCT_CODE, b"MTi-630-8A1G6   "),
        encode(XbusMessageId.FIRMWARE, setup.encode_firmware(setup.Firmware(1, 2, 3, 4, 5))),
        encode(XbusMessageId.FILTER_PROFILE_ACK, b"General/VRU"),
        encode(XbusMessageId.OUTPUT_CONFIGURATION_ACK, bytes.fromhex("20100064")),
        encode(
            XbusMessageId.ALIGNMENT_ROTATION_ACK,
            setup.encode_alignment(setup.AlignmentRotation(1, IDENTITY)),
        ),
    )
    data: dict[str, object] = {}
    for kind, more in told(found):
        assert kind == "info"
        data |= more
    assert data == {
        "serial": "0360A1B2", "model": "MTi-630-8A1G6", "firmware": "1.2.3",
        "filter_profile": "General/VRU", "outputs": {"0x2010": 100},
        "alignment_local": list(IDENTITY),
    }  # fmt: skip


def test_an_error_of_the_device_is_an_event_in_words() -> None:
    (event,) = fed(decoder(), encode(XbusMessageId.ERROR, b"\x1e"))
    assert isinstance(event, DeviceEvent)
    assert (event.kind, dict(event.data)) == ("error", {"code": 0x1E})
    assert "baud" in event.text


@pytest.mark.parametrize("bus_ids", [(1, 2), (0xFF, 3, 1)])
def test_measurements_of_several_devices_on_one_line_are_not_mixed(
    bus_ids: tuple[int, ...],
) -> None:
    def wire(k: int, bus_id: int) -> bytes:
        data = message(k, 100 * k)[4:-1]
        return encode(XbusMessageId.MT_DATA2, data, bus_id)

    events = fed(decoder(), *(wire(k, bus_id) for k in range(40) for bus_id in bus_ids))
    assert [one.counter for one in samples(events)] == list(range(40))
    (warning,) = [one for one in events if isinstance(one, DeviceEvent)]
    assert warning.kind == "warning"
    assert f"of bus id {bus_ids[0]} are used" in warning.text
    assert set(bus_ids[:1]) < set(warning.data["bus_ids"]) <= set(bus_ids)  # type: ignore[call-overload]


@pytest.mark.parametrize("bus_id", [1, 2, 0xFF])
def test_the_configured_device_of_a_line_with_several_is_used(bus_id: int) -> None:
    ids = (1, 2, 0xFF)
    wire = [
        encode(XbusMessageId.MT_DATA2, message(k, 100 * k + place)[4:-1], number)
        for k in range(200)
        for place, number in enumerate(ids)
    ]
    events = fed(XbusDecoder(115_200, 100.0, bus_id=bus_id), *wire)
    place = ids.index(bus_id)
    assert [one.ticks for one in samples(events)] == [100 * k + place for k in range(200)]
    (info,) = [one for one in events if isinstance(one, DeviceEvent)]
    assert info.kind == "info"


def test_one_measurement_with_another_bus_id_does_not_stop_the_device() -> None:
    stray = encode(XbusMessageId.MT_DATA2, message(0, 0)[4:-1], 9)
    events = fed(decoder(), stray, *(message(k, 100 * k) for k in range(200)))
    assert len(samples(events)) > 130
