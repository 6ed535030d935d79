"""The decoder of LPMS sensors on CAN, and the recognition of their identifiers."""

from __future__ import annotations

import asyncio
import random
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from jointfit_daemon.driver import CanBusSettings, DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import Chunk, Corrupt, DeviceEvent, ImuSample
from jointfit_daemon.tools.discovery import decode_frames
from jointfit_drivers.lpms import LpmsCanDecoder, LpmsCanIdSettings, LpmsCanImu, LpmsCanSettings
from jointfit_drivers.lpms._arrival_gaps import ArrivalGaps
from jointfit_protocols.can import RECORD_BYTES, CanFrame, host_dropped, pack_frames
from jointfit_protocols.lpms import LpBusCodec, LpBusMessage
from jointfit_protocols.lpms.channels import encode_heartbeat, sequential_ids, tpdo_ids
from jointfit_protocols.lpms.configuration import GENERATION_1
from jointfit_protocols.lpms.measurement import PacketLayout
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import LpmsCanDevice, LpmsCanDeviceOptions
from jointfit_simulators.wires import PythonCanWire, SlcanAdapter
from tests.drivers.driver_run import DriverRun, serving

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.model import Decoded

PERIOD_NS = 10_000_000


class RecordingWire:
    """A wire that stores frames."""

    def __init__(self) -> None:
        self.frames: list[CanFrame] = []
        self.is_open, self.bitrate = True, None

    def send(self, frames: Any) -> bool:
        self.frames += frames
        return True


def settings(
    numbers: tuple[int, ...] = tpdo_ids(1), mode: str = "canopen", precision: str = "int16",
    **more: Any,
) -> LpmsCanSettings:  # fmt: skip
    ids = {f"frame{k}": number for k, number in enumerate(numbers, 1)}
    table: dict[str, Any] = {"can": {"interface": "virtual", "channel": "test"}} | more
    return LpmsCanSettings.model_validate(
        {"id": "S3", "segment": "shank", "driver": "lpms-can", "mode": mode, "ids": ids,
         "precision": precision, **table}
    )  # fmt: skip


def recorded(count: int, **options: Any) -> list[CanFrame]:
    """Return the frames of `count` samples every 10 ms, with 0.2 ms between frames."""
    wire = RecordingWire()
    device = LpmsCanDevice(wire, LpmsCanDeviceOptions(**options))  # type: ignore[arg-type]
    stamped: list[CanFrame] = []
    for number in range(count):
        wire.frames.clear()
        device.push(number * PERIOD_NS, orientation(number))
        stamped += [
            frame._replace(t_ns=(number + 1) * PERIOD_NS + k * 200_000)
            for k, frame in enumerate(wire.frames)
        ]
    return stamped


def fed(under_test: LpmsCanDecoder, frames: list[CanFrame]) -> list[Decoded]:
    return [e for f in frames for e in under_test.feed(Chunk(f.t_ns, pack_frames([f])))]


def samples(events: list[Decoded]) -> list[ImuSample]:
    return [event for event in events if isinstance(event, ImuSample)]


def texts(events: list[Decoded], kind: str) -> list[str]:
    return [e.text for e in events if isinstance(e, DeviceEvent) and e.kind == kind]


def test_lpbus_in_can_frames_is_the_stream_of_the_serial_line() -> None:
    """Generation 1 can also send LP-BUS packets in CAN frames. No driver supports this mode."""
    frames = recorded(3, mode="lpbus", node=1)
    assert {frame.can_id for frame in frames} == {0x515}
    assert max(len(frame.data) for frame in frames) == 8
    found = LpBusCodec().feed(b"".join(frame.data for frame in frames))
    layout = PacketLayout(GENERATION_1, GENERATION_1.quaternion)
    packets = [layout.decode(item.data) for item in found if isinstance(item, LpBusMessage)]
    assert [packet.tick for packet in packets if packet] == [0, 4, 8]


CASES: dict[str, tuple[dict[str, Any], LpmsCanSettings]] = {
    "canopen-16": ({}, settings()),
    "canopen-32": ({"precision": "float32"}, settings(precision="float32")),
    "old-firmware": (
        {"mode": "sequential", "ids": sequential_ids(2, spaced=True), "unit": 1_000},
        settings(sequential_ids(2, spaced=True), "sequential"),
    ),
    "mapped": (
        {"precision": "float32", "mapping": (7, 3, 4, 8), "world": "ENU", "world_to_sensor": False},
        settings(precision="float32", mapping=(7, 3, 4, 8), world="ENU",
                 direction="sensor_to_world"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_every_sample_arrives_with_the_stamp_of_its_first_frame(case: str) -> None:
    options, table = CASES[case]
    under_test = LpmsCanDecoder(table)
    frames = recorded(60, **options)
    found = fed(under_test, frames)
    assert len(samples(found)) == 60
    for number, sample in enumerate(samples(found)):
        product = sum(
            a * b for a, b in zip(sample.q_world_sensor, orientation(number), strict=True)
        )
        assert abs(product) > 1 - 1e-5
        assert (number + 1) * PERIOD_NS <= sample.arrival_ns < (number + 2) * PERIOD_NS
    assert under_test.discarded_bytes == 0
    assert under_test.messages == len(frames)
    assert not texts(found, "warning") + texts(found, "gap")


def test_halves_out_of_order_are_counted_and_reported() -> None:
    """A quaternion of 32-bit floats takes two frames: its halves."""
    wire = RecordingWire()
    device = LpmsCanDevice(wire, LpmsCanDeviceOptions(precision="float32"))  # type: ignore[arg-type]
    device.swapped = True
    for number in range(20):
        device.push(number * PERIOD_NS, orientation(number))
    frames = [f._replace(t_ns=k * PERIOD_NS // 4) for k, f in enumerate(wire.frames)]
    under_test = LpmsCanDecoder(settings(precision="float32"))
    found = fed(under_test, frames)
    assert not samples(found)
    (text,) = texts(found, "warning")
    assert "do not follow each other within half a period" in text
    assert under_test.discarded_bytes >= 38 * RECORD_BYTES


def test_a_lost_half_costs_one_sample() -> None:
    frames = recorded(40, precision="float32", heartbeat_hz=0)
    assert [f.can_id for f in frames[80:84]] == list(tpdo_ids(1))
    found = fed(LpmsCanDecoder(settings(precision="float32")), frames[:81] + frames[82:])
    assert len(samples(found)) == 39
    assert sum(e.discarded for e in found if isinstance(e, Corrupt)) == RECORD_BYTES
    assert texts(found, "gap") == ["1 samples lost"]


def test_frames_that_the_host_lost_end_an_open_sample() -> None:
    """The second frame of the open sample may be among the lost ones."""
    frames = recorded(2, precision="float32", heartbeat_hz=0, sends_idle_frames=False)
    (first, _), (_, last) = frames[:2], frames[2:]
    near = last._replace(t_ns=first.t_ns + 1000)
    found = fed(
        LpmsCanDecoder(settings(precision="float32")), [first, host_dropped(first.t_ns, 2), near]
    )
    assert not samples(found)
    assert texts(found, "warning") == ["this host was too slow: the kernel dropped 2 CAN frames"]


def test_a_wrong_precision_is_named_with_the_norm() -> None:
    found = fed(LpmsCanDecoder(settings(precision="float32")), recorded(120))
    assert not samples(found)
    assert any('the data fit precision = "int16"' in text for text in texts(found, "warning"))
    found = fed(LpmsCanDecoder(settings()), recorded(120, mapping=(9, 10, 11, 12)))
    assert not samples(found)
    (text,) = texts(found, "warning")
    assert text.startswith("median quaternion norm is 0, expected 1: change `precision`")


def test_heartbeats_report_a_start_and_a_stop_once() -> None:
    beats = [encode_heartbeat(0x701, state, k) for k, state in enumerate((5, 5, 0, 5, 4, 4))]
    found = fed(LpmsCanDecoder(settings()), beats)
    assert [(e.kind, e.text[:32]) for e in found if isinstance(e, DeviceEvent)] == [
        ("restart", "device restarted (its heartbeat "),
        ("warning", "the heartbeat of the sensor repo"),
    ]


def arrivals(gaps: ArrivalGaps, times: list[float]) -> tuple[int, list[float]]:
    steps = [gaps.add(round(t * 1e6)) for t in times]
    return sum(step.lost for step in steps), [s.rate_hz for s in steps if s.rate_hz]


@given(st.integers(0, 2**32), st.integers(20, 150), st.integers(1, 7))
def test_delays_are_no_losses_and_losses_are_counted(seed: int, place: int, lost: int) -> None:
    """Without a counter, the number of lost samples is found from the arrival times."""
    chance = random.Random(seed)
    sound = [10.0 * k + (chance.uniform(0, 8) if k % 9 else 0.0) for k in range(200)]
    assert arrivals(ArrivalGaps(100.0), sound) == (0, [])
    torn = [t + (10.0 * lost if k >= place else 0.0) for k, t in enumerate(sound)]
    assert arrivals(ArrivalGaps(100.0), torn) == (lost, [])


def test_another_rate_is_reported_once_and_is_no_loss_afterwards() -> None:
    for period_ms in (20.0, 5.0):
        _, rates = arrivals(ArrivalGaps(100.0), [period_ms * k for k in range(300)])
        assert rates == [pytest.approx(1000 / period_ms)]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"numbers": (0x181, 0x281, 0x381, 0x482)}, "CANopen style is 0x180"),
        ({"numbers": (0x180, 0x280, 0x380, 0x480)}, "CANopen style is 0x180"),
        ({"mode": "sequential"}, "sequential identifiers follow each other, found 0x181"),
        ({"mapping": (1, 2, 3, 3)}, "four different channels from 1 to 16"),
        ({"precision": "float32", "mapping": (1, 2, 3, 9)}, "four different channels from 1 to 8"),
        ({"numbers": (0x181, 0x281, 0x381, 0x881)}, "ids.frame4"),
        ({"numbers": (0x181, 0x281)}, "ids.frame3"),
        ({"mode": "lpbus"}, "mode"),
    ],
)
def test_settings_that_cannot_work_are_refused(change: dict[str, Any], text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        settings(**change)


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({}, ("canopen", 0x181, "int16")),
        ({"precision": "float32"}, ("canopen", 0x181, "float32")),
        ({"unit": 1_000, "sends_idle_frames": False}, ("canopen", 0x181, "int16")),
        (
            {"mode": "sequential", "ids": sequential_ids(1, spaced=False)},
            ("sequential", 0x515, "int16"),
        ),
        (
            {"mode": "sequential", "ids": sequential_ids(3, spaced=True), "precision": "float32"},
            ("sequential", 0x524, "float32"),
        ),
    ],
)
def test_a_sensor_on_a_bus_is_recognized(
    options: dict[str, Any], found: tuple[str, int, str]
) -> None:
    frames = recorded(30, **options)
    sizes = {(frame.can_id, False): len(frame.data) for frame in frames}
    chunks = [Chunk(frame.t_ns, pack_frames([frame])) for frame in frames]
    (device,) = decode_frames(sizes, chunks)
    assert device.driver == "lpms-can"
    table = device.settings
    assert (table["mode"], table["ids"]["frame1"], table["precision"]) == found
    assert device.usual_rate_hz == 100


@pytest.mark.real_time
async def test_overlapping_identifiers_of_neighbours_are_refused_by_name(tmp_path: Path) -> None:
    bus = CanBusSettings(interface="virtual", channel=str(tmp_path))
    first, second = (
        settings(sequential_ids(node, spaced=False), "sequential", can=bus, id=f"S{node}")
        for node in (1, 2)
    )
    run = DriverRun(LpmsCanImu(first))
    await asyncio.sleep(0.05)
    with pytest.raises(DeviceMisconfiguredError, match=r"0x516 .*also used by S1.*LpmsControl"):
        await LpmsCanImu(second).run(lambda _: None)
    await run.cancel()


@pytest.mark.real_time
async def test_wrong_identifiers_are_named_with_those_that_fit(tmp_path: Path) -> None:
    device = LpmsCanDevice(
        SlcanAdapter(tmp_path / "adapter"),
        LpmsCanDeviceOptions(node=5, heartbeat_hz=0, sends_idle_frames=False),
    )
    bus = CanBusSettings(interface="slcan", channel=str(tmp_path / "adapter"))
    async with serving(device, feeding=True):
        with pytest.raises(DeviceLostError, match=r"0x185 look like a frame1: set `ids.frame1`"):
            await LpmsCanImu(settings(can=bus, silence_s=0.3)).run(lambda _: None)


@pytest.mark.real_time
async def test_four_sensors_share_a_bus(tmp_path: Path) -> None:
    channel = str(tmp_path)
    wire = PythonCanWire("virtual", channel)
    devices = [LpmsCanDevice(wire, LpmsCanDeviceOptions(node=node)) for node in range(1, 5)]
    bus = CanBusSettings(interface="virtual", channel=channel)
    runs = [DriverRun(LpmsCanImu(settings(tpdo_ids(n), can=bus, id=f"S{n}"))) for n in range(1, 5)]
    await asyncio.sleep(0.1)
    for number in range(30):
        for device in devices:
            device.push(number * PERIOD_NS, orientation(number))
        await asyncio.sleep(0.002)
    for run in runs:
        await run.wait_for(30)
        assert len(run.samples) == 30
        assert run.decoder.discarded_bytes == 0
        await run.cancel()
    wire.unplug()


def test_ids_are_immutable() -> None:
    ids = LpmsCanIdSettings(frame1=1, frame2=2, frame3=3, frame4=4)
    with pytest.raises(ValidationError):
        ids.frame1 = 5  # type: ignore[misc]
