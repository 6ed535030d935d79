"""The decoder of the XCDI driver: samples, gaps, restarts, units, and shared identifiers."""

from __future__ import annotations

import json
import random
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from jointfit_daemon.driver import CanBusSettings
from jointfit_daemon.files.captures._candump import read_candump
from jointfit_daemon.model import Chunk, Corrupt, DeviceEvent, ImuSample, TickClock
from jointfit_drivers.xcdi import XcdiDecoder, XcdiIdSettings, XcdiImu, XcdiSettings
from jointfit_protocols.can import RECORD_BYTES, CanFrame, host_corrupt, host_dropped, pack_frames
from jointfit_protocols.xcdi import DataId, XcdiIds, id_block
from jointfit_simulators.devices import XcdiDevice, XcdiDeviceOptions

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

IDENTITY = (1.0, 0.0, 0.0, 0.0)
MS = 1_000_000


class FrameTape:
    """Wire that stores the sent frames with a time stamp of the test."""

    bitrate: int | None = None

    is_open = True

    def __init__(self) -> None:
        self.frames: list[CanFrame] = []
        self.t_ns = 0

    def send(self, frames: Iterable[CanFrame]) -> bool:
        self.frames += [
            frame._replace(t_ns=self.t_ns + n * 100_000) for n, frame in enumerate(frames)
        ]
        return True

    async def run(self) -> None: ...
    def plug(self) -> None: ...
    def unplug(self) -> None: ...

    def play(self, device: XcdiDevice, numbers: Iterable[int], period_ns: int = 10 * MS) -> None:
        for number in numbers:
            self.t_ns = 10**9 + number * period_ns
            device.push(number * period_ns, IDENTITY)


def events(unit: str = "100us", ids: XcdiIds | None = None) -> XcdiDecoder:
    return XcdiDecoder(ids or XcdiIds(), unit, "big", 100.0)


def decoded(tape: FrameTape, decoder: XcdiDecoder | None = None) -> list[Any]:
    decoder = decoder or events()
    return decoder.feed(Chunk(0, pack_frames(tape.frames)))


def of_kind(found: list[Any], kind: str) -> list[DeviceEvent]:
    return [item for item in found if isinstance(item, DeviceEvent) and item.kind == kind]


def samples(found: list[Any]) -> list[ImuSample]:
    return [item for item in found if isinstance(item, ImuSample)]


def settings(**more: Any) -> XcdiSettings:
    bus = CanBusSettings(channel="can0")
    return XcdiSettings(id="S3", segment="shank", driver="xcdi", can=bus, **more)


def test_the_vectors_are_canonical_quaternions_or_refused(shared_data: Path) -> None:
    everything = json.loads((shared_data / "imu" / "vectors.json").read_text())
    for vector in everything:
        if vector["protocol"] != "xsens-xcdi" or vector["can_id"] != 0x21:
            continue
        frame = CanFrame(5, 0x21, bytes.fromhex(vector["hex"]))
        found = events().feed(Chunk(0, pack_frames([frame])))
        if not vector["valid"]:
            assert [type(item) for item in found] == [Corrupt]
            continue
        (sample,) = samples(found)
        assert sample.q_native == pytest.approx(vector["decoded"]["native_wxyz"], abs=1e-9)
        sign = 1 if sample.q_world_sensor[0] * vector["decoded"]["canonical_wxyz"][0] >= 0 else -1
        assert [sign * part for part in sample.q_world_sensor] == pytest.approx(
            vector["decoded"]["canonical_wxyz"], abs=1e-8
        )


def test_a_sample_has_the_first_frames_stamp_and_the_devices_time() -> None:
    tape = FrameTape()
    tape.play(XcdiDevice(tape, XcdiDeviceOptions(first_tick=2**32 - 50)), range(3))
    found = samples(decoded(tape))
    assert [each.arrival_ns for each in found] == [10**9, 10**9 + 10 * MS, 10**9 + 20 * MS]
    assert [each.ticks for each in found] == [2**32 - 50, 50, 150]
    assert [each.counter for each in found] == [0, 1, 2]
    assert found[0].status == 2


@pytest.mark.parametrize(("unit", "tick_ns"), [("100us", 100_000), ("1us", 1_000)])
def test_unit_of_the_sample_time_is_detected_and_reported(unit: str, tick_ns: int) -> None:
    tape, decoder = FrameTape(), events("auto")
    tape.play(XcdiDevice(tape, XcdiDeviceOptions(sample_time_unit=unit)), range(12))
    clocks = []
    told: list[DeviceEvent] = []
    for frame in tape.frames:
        told += of_kind(decoder.feed(Chunk(0, pack_frames([frame]))), "info")
        clocks.append(decoder.tick_clock)
    assert clocks[4 * 10] is None
    assert clocks[-1] == TickClock(tick_ns, 2**32)
    assert len(told) == 1
    assert told[0].data["sample_time_unit"] == unit


def test_frames_buffered_while_the_process_stood_still_do_not_change_the_unit() -> None:
    tape, decoder = FrameTape(), events("auto")
    device = XcdiDevice(tape)
    for number in range(300):  # the first 50 groups arrive together, 20 us apart
        tape.t_ns = 10**9 + max(number * 10 * MS, 500 * MS + number * 20_000)
        device.push(number * 10 * MS, IDENTITY)
    (info,) = of_kind(decoded(tape, decoder), "info")
    assert info.data["sample_time_unit"] == "100us"
    assert decoder.tick_clock == TickClock(100_000, 2**32)


@pytest.mark.parametrize("unit", ["auto", "100us"])
def test_a_pause_with_a_running_clock_and_a_counter_that_stands_is_no_restart(unit: str) -> None:
    tape, decoder = FrameTape(), events(unit)
    device = XcdiDevice(tape)
    tape.play(device, range(300))
    counter = device.counter
    tape.play(device, range(700, 800))  # 4 s without groups; the counter counts sent groups only
    assert device.counter == counter + 100
    found = decoded(tape, decoder)
    assert not of_kind(found, "restart")
    assert len(samples(found)) == 400


def test_wrong_configured_unit_is_reported_and_used() -> None:
    tape, decoder = FrameTape(), events("1us")
    tape.play(XcdiDevice(tape), range(20))
    (told,) = of_kind(decoded(tape, decoder), "warning")
    assert "sample_time_unit" in told.text
    assert "100us" in told.text
    assert decoder.tick_clock == TickClock(1_000, 2**32)


def test_lost_groups_are_one_gap_and_no_restart() -> None:
    for without_counter in (False, True):
        ids = XcdiIds(group_counter=None) if without_counter else XcdiIds()
        tape = FrameTape()
        device = XcdiDevice(tape, XcdiDeviceOptions(ids=ids))
        tape.play(device, range(20))
        device.lose(7)
        tape.play(device, range(20, 40))
        found = decoded(tape)
        assert [gap.data["lost"] for gap in of_kind(found, "gap")] == [7]
        assert not of_kind(found, "restart")
        assert len(samples(found)) == 33
        (gap,) = of_kind(found, "gap")
        assert len(samples(found[: found.index(gap)])) == 20


def test_a_lost_quaternion_is_a_gap_of_one() -> None:
    tape = FrameTape()
    device = XcdiDevice(tape)
    tape.play(device, range(20))
    device.lose_frames(DataId.QUATERNION, 1)
    tape.play(device, range(20, 40))
    decoder = events()
    found = decoded(tape, decoder)
    assert [gap.data["lost"] for gap in of_kind(found, "gap")] == [1]
    assert decoder._xcdi.incomplete == 1


def test_a_lost_sample_time_costs_the_time_and_not_the_sample() -> None:
    tape = FrameTape()
    device = XcdiDevice(tape)
    tape.play(device, range(20))
    device.lose_frames(DataId.SAMPLE_TIME, 3)
    tape.play(device, range(20, 40))
    found = decoded(tape)
    assert [each.ticks is None for each in samples(found)].count(True) == 3
    assert len(samples(found)) == 40
    assert not of_kind(found, "gap")
    assert not of_kind(found, "restart")


@pytest.mark.parametrize("before", [3, 20])
@pytest.mark.parametrize("lost", [0, 2])
def test_a_lost_counter_is_not_taken_for_lost_samples(before: int, lost: int) -> None:
    tape = FrameTape()
    device = XcdiDevice(tape)
    tape.play(device, range(before))
    device.lose_frames(DataId.GROUP_COUNTER, 2)
    tape.play(device, range(before, before + 2))
    device.lose(lost)
    device.lose_frames(DataId.GROUP_COUNTER, 2)
    tape.play(device, range(before + 2, 40))
    found = decoded(tape)
    assert len(samples(found)) == 40 - lost
    assert sum(gap.data["lost"] for gap in of_kind(found, "gap")) == lost  # type: ignore[misc]
    assert not of_kind(found, "restart")


def test_wraps_of_counter_and_time_are_no_gap_and_no_restart() -> None:
    tape = FrameTape()
    options = XcdiDeviceOptions(first_tick=2**32 - 5000, first_counter=2**16 - 30)
    tape.play(XcdiDevice(tape, options), range(200))
    found = decoded(tape)
    assert len(samples(found)) == 200
    assert not [item for item in found if isinstance(item, DeviceEvent) and item.kind != "info"]


def test_a_power_cycle_is_one_restart() -> None:
    for first_tick in (0, 5_000_000, 4_000_000_000):
        tape = FrameTape()
        device = XcdiDevice(tape, XcdiDeviceOptions(first_tick=first_tick, first_counter=900))
        tape.play(device, range(50))
        tape.play(XcdiDevice(tape), range(50, 100))
        found = decoded(tape)
        assert len(of_kind(found, "restart")) == 1
        assert len(samples(found)) == 100


def test_device_without_sample_time_is_decoded_and_reported_once() -> None:
    tape = FrameTape()
    tape.play(XcdiDevice(tape, XcdiDeviceOptions(ids=XcdiIds(sample_time=None))), range(100))
    found = decoded(tape, events("auto"))
    assert len(samples(found)) == 100
    (told,) = of_kind(found, "warning")
    assert "without SampleTime" in told.text


@pytest.mark.parametrize("offset_ms", [0.3, 3, 5])
@pytest.mark.parametrize(
    "ahead", [(7, 300_000), (0, 0), (1, 0), (2, 40), (0, 103), (30_000, 2**31)]
)
def test_two_sensors_on_one_identifier_are_detected_and_neither_is_used(
    ahead: tuple[int, int], offset_ms: float
) -> None:
    first = FrameTape()
    tape_of_both: list[CanFrame] = []
    a = XcdiDevice(first, XcdiDeviceOptions(first_tick=100))
    b = XcdiDevice(first, XcdiDeviceOptions(first_counter=ahead[0], first_tick=ahead[1]))
    for number in range(200):
        first.t_ns = number * 10 * MS
        a.push(first.t_ns, IDENTITY)
        first.t_ns += round(offset_ms * MS)
        b.push(first.t_ns, (0.0, 1.0, 0.0, 0.0))
    tape_of_both = first.frames
    found = events().feed(Chunk(0, pack_frames(tape_of_both)))
    assert len(samples(found)) < 30
    (told,) = of_kind(found, "warning")
    assert "two sensors" in told.text
    assert "identifiers of its own" in told.text
    assert len(of_kind(found, "restart")) <= 3


def test_two_sensors_that_alternate_frame_by_frame_are_detected() -> None:
    tape = FrameTape()
    a, b = XcdiDevice(tape), XcdiDevice(tape, XcdiDeviceOptions(first_counter=500))
    for number in range(200):
        groups = [each.group(number * 10 * MS, IDENTITY) for each in (a, b)]
        tape.frames += [frame for pair in zip(*groups, strict=True) for frame in pair]
    found = decoded(tape)
    assert len(samples(found)) < 30
    assert len(of_kind(found, "warning")) == 1


def interleaved(groups: list[list[CanFrame]], order: random.Random) -> list[CanFrame]:
    """Return frames of several groups in random order; the order within a group remains."""
    left = [list(group) for group in groups if group]
    mixed: list[CanFrame] = []
    while left:
        mixed.append(order.choice(left).pop(0))
        left = [group for group in left if group]
    return mixed


def test_interleaved_groups_of_two_sensors_on_one_identifier_are_detected() -> None:
    order, tape = random.Random(2), FrameTape()
    a, b = XcdiDevice(tape), XcdiDevice(tape, XcdiDeviceOptions(first_counter=500))
    frames: list[CanFrame] = []
    for number in range(200):
        groups = [a.group(number * 10 * MS, IDENTITY), b.group(number * 10 * MS, IDENTITY)]
        frames += [f._replace(t_ns=number * 10 * MS) for f in interleaved(groups, order)]
    found = events().feed(Chunk(0, pack_frames(frames)))
    assert len(samples(found)) < 60
    assert len(of_kind(found, "warning")) == 1


def test_when_the_second_sensor_is_gone_the_first_is_used_again() -> None:
    tape = FrameTape()
    a, b = XcdiDevice(tape), XcdiDevice(tape, XcdiDeviceOptions(first_counter=500))
    for number in range(100):
        tape.t_ns = number * 10 * MS
        a.push(tape.t_ns, IDENTITY)
        b.push(tape.t_ns + 5 * MS, IDENTITY)
    tape.play(a, range(100, 200))
    found = decoded(tape)
    assert len(samples(found)[-70:]) == 70
    assert samples(found)[-1].counter == 199
    assert [item.counter for item in samples(found)[-70:]] == list(range(130, 200))
    assert len(of_kind(found, "warning")) == 1


def test_a_wrong_byte_order_is_named_after_a_hundred_samples() -> None:
    tape = FrameTape()
    device = XcdiDevice(tape)
    for number in range(150):
        device.push(number * 10 * MS, (0.5, -0.5, 0.1, 0.7))
    found = XcdiDecoder(XcdiIds(), "100us", "little", 100.0).feed(
        Chunk(0, pack_frames(tape.frames))
    )
    assert not samples(found)
    told = [event for event in of_kind(found, "warning") if "byte_order" in event.text]
    assert len(told) == 1


def test_overflow_is_reported_once_a_second() -> None:
    tape = FrameTape()
    device = XcdiDevice(tape)
    for number in range(30):
        tape.t_ns = number * 100 * MS
        device.overflow()
    told = of_kind(decoded(tape), "error")
    assert len(told) == 3
    assert "overflowed" in told[0].text


def test_error_frames_of_the_host_are_reported_and_counted() -> None:
    decoder = events()
    notes = [host_dropped(0, 4722), host_corrupt(0, 33), CanFrame(0, 0x40, bytes(8), error=True)]
    dropped, corrupt, bus_off = decoder.feed(Chunk(0, pack_frames(notes)))
    assert isinstance(dropped, DeviceEvent)
    assert dropped.data["dropped_frames"] == 4722
    assert corrupt == Corrupt(33, "no SLCAN line")
    assert decoder.discarded_bytes == 33
    assert isinstance(bus_off, DeviceEvent)
    assert bus_off.kind == "error"


@given(st.lists(st.binary(max_size=100)))
def test_every_record_is_used_foreign_or_discarded(chunks: list[bytes]) -> None:
    decoder = events("auto")
    corrupt = 0
    for data in chunks:
        for item in decoder.feed(Chunk(0, data)):
            corrupt += item.discarded if isinstance(item, Corrupt) else 0
    assert corrupt == decoder.discarded_bytes <= sum(map(len, chunks))


data_frames = st.builds(
    CanFrame,
    st.integers(0, 10**12),
    st.sampled_from([0x01, 0x05, 0x06, 0x11, 0x21, 0x44]),
    st.binary(max_size=8) | st.just(b"\x7f\xff\0\0\0\0\0\0"),
    extended=st.just(False),
    error=st.just(False),
    remote=st.booleans(),
)


@given(st.lists(data_frames, max_size=200))
def test_messages_and_losses_add_up(frames: list[CanFrame]) -> None:
    decoder = events("auto")
    decoder.feed(Chunk(0, pack_frames(frames)))
    used = (decoder.messages + decoder._xcdi.foreign) * RECORD_BYTES
    assert used + decoder.discarded_bytes == len(frames) * RECORD_BYTES


def test_identifiers_left_out_move_with_their_block() -> None:
    assert XcdiIdSettings().resolve() == XcdiIds()
    block = XcdiIdSettings(sample_time=0x105, group_counter=0x106, quaternion=0x121)
    assert block.resolve() == id_block(0x100)
    alone = XcdiIdSettings(sample_time=0x105, group_counter=0x107, quaternion=0x121)
    assert (alone.resolve().error, alone.resolve().status_word) == (None, None)


@pytest.mark.parametrize("base", [-1, 0, 1, 0x7DE, 0x7DF, 0x7FE])
def test_derived_identifiers_never_leave_the_range_of_the_given_ones(base: int) -> None:
    """The quaternion has the largest identifier of the block. It is always given and checked."""
    ids = {"sample_time": base + 5, "group_counter": base + 6, "quaternion": base + 0x21}
    if base + 0x21 > 0x7FF:
        with pytest.raises(ValidationError, match="above 0x7FF, the greatest 11-bit identifier"):
            settings(ids=ids)
    else:
        found = XcdiIdSettings(**ids).resolve()
        assert all(0 <= number <= 0x7FF for number in found[:5] if number is not None)
        assert (found.error is None) == (base < 0)


@pytest.mark.parametrize(
    ("ids", "words"),
    [
        (
            {"sample_time": 0x130},
            "0x130, group_counter 0x6, .* sample_time < group_counter < quaternion",
        ),
        ({"error": 0x05}, "found 0x5 for sample_time and error"),
        ({"status_word": 0x01}, "0x1 for status_word and error .error is derived from the others"),
        ({"quaternion": 2**29}, "less than or equal"),
        ({"quaternion": 0x821}, "ids.quaternion = 0x821 is above 0x7FF.*extended_ids = true"),
        ({"quaternions": 3}, "Extra inputs"),
    ],
)
def test_identifiers_that_cannot_work_are_refused(ids: dict[str, int], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        settings(ids=ids)


def test_a_candump_log_is_decoded() -> None:
    tape = FrameTape()
    tape.play(XcdiDevice(tape), range(100))
    log = "".join(f"({f.t_ns / 1e9:.6f}) can0 {f.can_id:03X}#{f.data.hex()}\n" for f in tape.frames)
    decoder = XcdiImu(settings()).decoder()
    found = [
        item for chunk in read_candump(log.encode() + b"cut li") for item in decoder.feed(chunk)
    ]
    assert len(samples(found)) == 100
    assert decoder.messages == 400
    assert [type(item) for item in found].count(Corrupt) == 1
