"""Shared CAN buses: distribution of frames, failures of one driver, and error messages."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from pydantic import ValidationError
from typing_extensions import override

from jointfit_daemon.driver import CanBusSettings, DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import Chunk, Corrupt
from jointfit_drivers.xcdi import XcdiIdSettings, XcdiImu, XcdiSettings
from jointfit_protocols.can import CanFrame
from jointfit_protocols.can.slcan import encode_frame
from jointfit_protocols.xcdi import id_block
from jointfit_simulators.devices import XcdiDevice, XcdiDeviceOptions
from jointfit_simulators.wires import PtyLine, SlcanAdapter
from tests.drivers.driver_run import IDENTITY, DriverRun, serving, xcdi_driver

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from jointfit_protocols.can.slcan import SlcanLine


def bus_at(folder: Path, **more: Any) -> CanBusSettings:
    return CanBusSettings(interface="slcan", channel=str(folder / "adapter"), **more)


async def opened(adapter: SlcanAdapter) -> None:
    async with asyncio.timeout(5):
        while not adapter.is_open:
            await asyncio.sleep(0.005)
        await asyncio.sleep(0.05)


async def lost(running: DriverRun, within_s: float = 1.0) -> str:
    async with asyncio.timeout(within_s):
        with pytest.raises(DeviceLostError) as told:
            await running.task
    return str(told.value)


def two_sensors(adapter: SlcanAdapter) -> tuple[XcdiDevice, XcdiDevice]:
    return (
        XcdiDevice(adapter, XcdiDeviceOptions(ids=id_block(0x100))),
        XcdiDevice(adapter, XcdiDeviceOptions(ids=id_block(0x200), first_counter=1000)),
    )


async def test_two_sensors_on_one_adapter_each_get_their_own(tmp_path: Path) -> None:
    """Each driver receives only the samples of its own sensor."""
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)
    devices = two_sensors(adapter)
    async with serving(*devices):
        runs = [DriverRun(xcdi_driver("S3", bus, 0x100)), DriverRun(xcdi_driver("S4", bus, 0x200))]
        await opened(adapter)
        for number in range(50):
            for device in devices:
                device.push(number * 10_000_000, IDENTITY)
            await asyncio.sleep(0.001)
        for run in runs:
            await run.wait_for(50)
        assert [each.counter for each in runs[0].samples] == list(range(50))
        assert [each.counter for each in runs[1].samples] == list(range(1000, 1050))
        assert [run.decoder._xcdi.foreign for run in runs] == [0, 0]
        await runs[0].cancel()
        assert adapter.is_open, "the bus stays open for the other"
        await runs[1].cancel()
        await asyncio.sleep(0.05)
        assert not adapter.is_open, "the last user closes the bus"


class Eager(SlcanAdapter):
    """Adapter that sends a sensor's first group in the same write as its answer to open."""

    sensor: XcdiDevice
    group: list[CanFrame] | None = None

    @override
    def send(self, frames: Iterable[CanFrame]) -> bool:
        if self.group is None:
            return super().send(frames)
        self.group += frames
        return True

    @override
    def _execute(self, line: SlcanLine) -> bytes:
        answer = super()._execute(line)
        if line.letter != "O":
            return answer
        self.group = []
        self.sensor.push(0, IDENTITY)
        frames, self.group = self.group, None
        return answer + b"".join(encode_frame(frame, None) for frame in frames)


async def test_slcan_bus_delivers_frames_that_come_with_the_answer_to_open(tmp_path: Path) -> None:
    adapter, bus = Eager(tmp_path / "adapter"), bus_at(tmp_path)
    device, _ = two_sensors(adapter)
    adapter.sensor = device
    async with serving(device):
        run = DriverRun(xcdi_driver("S3", bus, 0x100))
        await opened(adapter)
        device.push(10_000_000, IDENTITY)
        await run.wait_for(2)
        await run.cancel()
    assert [sample.counter for sample in run.samples] == [0, 1]


async def test_all_sensors_of_an_unplugged_adapter_are_lost_and_return(tmp_path: Path) -> None:
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)
    devices = two_sensors(adapter)
    drivers = [xcdi_driver("S3", bus, 0x100), xcdi_driver("S4", bus, 0x200)]
    async with serving(*devices):
        runs = list(map(DriverRun, drivers))
        await opened(adapter)
        adapter.unplug()
        for run in runs:
            assert "adapter" in await lost(run)
        adapter.plug()
        runs = list(map(DriverRun, drivers))
        await opened(adapter)
        for number in range(10):
            for device in devices:
                device.push(number * 10_000_000, IDENTITY)
        for run in runs:
            await run.wait_for(10)
            await run.cancel()


async def test_only_the_silent_sensor_is_lost_and_its_report_lists_received_identifiers(
    tmp_path: Path,
) -> None:
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)
    talks, _ = two_sensors(adapter)
    async with serving(talks):
        heard = DriverRun(xcdi_driver("S3", bus, 0x100))
        silent = DriverRun(xcdi_driver("S4", bus, 0x200, silence_s=0.4))
        await opened(adapter)
        for number in range(60):
            talks.push(number * 10_000_000, IDENTITY)
            if silent.task.done():
                break
            await asyncio.sleep(0.01)
        told = await lost(silent)
        assert told.startswith(f"{bus.channel}: "), "the daemon prefixes the sensor"
        assert "no quaternion (0x221) arrives, while other sensors send" in told
        assert not heard.task.done()
        await heard.cancel()


async def test_identifiers_of_a_sensor_that_waits_for_its_retry_are_not_unclaimed(
    tmp_path: Path,
) -> None:
    """The report of one sensor does not list identifiers of another configured sensor."""
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)

    async def without_orientation() -> None:
        while True:
            for start in (0x100, 0x200):
                frames = [CanFrame(0, start + 5, bytes(4)), CanFrame(0, start + 6, bytes(2))]
                adapter.send(frames)
            await asyncio.sleep(0.01)

    async with serving(adapter):
        first = DriverRun(xcdi_driver("S3", bus, 0x100, silence_s=0.3))
        second = DriverRun(xcdi_driver("S4", bus, 0x200, silence_s=0.8))
        await opened(adapter)
        sending = asyncio.create_task(without_orientation())
        texts = [await lost(first), await lost(second)]
        sending.cancel()
    for text in texts:
        assert "though sample_time" in text
        assert "claims" not in text


async def test_a_sensor_that_worked_and_falls_silent_has_one_text_at_all_attempts(
    tmp_path: Path,
) -> None:
    """An error that is repeated with the same text is logged once."""
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)
    device = XcdiDevice(adapter, XcdiDeviceOptions(ids=id_block(0x100)))
    driver, told = xcdi_driver("S3", bus, 0x100, silence_s=0.2), []
    async with serving(device):
        for attempt in range(3):
            run = DriverRun(driver)
            if not attempt:
                await opened(adapter)
                device.push(0, IDENTITY)
            told.append(await lost(run))
    assert told == 3 * [f"{bus.channel}: silent: check its power and wiring"]


async def test_a_sensor_that_came_late_is_reported_as_soon_as_one_that_was_there(
    tmp_path: Path,
) -> None:
    """On a silent bus, the waits between attempts become longer. The first frame ends a wait."""
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)
    device = XcdiDevice(adapter, XcdiDeviceOptions(ids=id_block(0x100)))
    driver = xcdi_driver("S3", bus, 0x100, silence_s=0.2)
    async with serving(device):
        for _ in range(3):  # waits of 0.2, 0.4 and 0.8 s
            await lost(DriverRun(driver), 2.0)
        run = DriverRun(driver)  # waits 1.6 s
        await opened(adapter)
        device.push(0, IDENTITY)
        await run.wait_for(1)
        assert "silent: check its power" in await lost(run, 0.7)


async def test_a_sensor_with_other_identifiers_is_hinted_at(tmp_path: Path) -> None:
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)
    device = XcdiDevice(adapter)
    async with serving(device):
        run = DriverRun(xcdi_driver("S3", bus, 0x300, silence_s=0.5))
        await opened(adapter)
        for number in range(10):
            device.push(number * 10_000_000, IDENTITY)
        told = await lost(run)
    assert "no quaternion (0x321) arrives" in told
    assert "that no sensor claims: 0x005, 0x006, 0x011, 0x021" in told
    assert "the data of 0x021 look like a quaternion: set `ids.quaternion` to it" in told


@pytest.mark.parametrize("extended", [True, False])
async def test_identifiers_of_another_width_are_no_reason_to_change_their_number(
    tmp_path: Path, extended: bool
) -> None:
    """The identifiers have the right number, but 29 instead of 11 bits, or the reverse."""
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)
    device = XcdiDevice(adapter, XcdiDeviceOptions(ids=id_block(0x200, extended=not extended)))
    ids = XcdiIdSettings(sample_time=0x205, group_counter=0x206, quaternion=0x221)
    async with serving(device):
        settings = XcdiSettings(
            id="S3", segment="shank", driver="xcdi", can=bus, ids=ids, silence_s=0.5,
            extended_ids=extended,
        )  # fmt: skip
        run = DriverRun(XcdiImu(settings))
        await opened(adapter)
        for number in range(10):
            device.push(number * 10_000_000, IDENTITY)
        told = await lost(run)
    remedy = "11 bits: remove `extended_ids`" if extended else "29 bits: set `extended_ids = true`"
    assert told.endswith(f"this number arrives as an identifier of {remedy}")
    assert "set `ids" not in told


async def test_missing_quaternion_is_reported_while_time_and_counter_arrive(
    tmp_path: Path,
) -> None:
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)
    device = XcdiDevice(adapter)
    async with serving(device):
        ids = XcdiIdSettings(quaternion=0x121)
        driver = XcdiImu(
            XcdiSettings(id="S3", segment="shank", driver="xcdi", can=bus, ids=ids, silence_s=0.5)
        )
        run = DriverRun(driver)
        await opened(adapter)
        sending = asyncio.create_task(send_on(device))
        told = await lost(run, 2.0)
        assert run.chunks == [], "a sensor without orientation is not there"
        again = DriverRun(driver)
        assert await lost(again, 3.0) == told, "the same text, which is reported once"
        sending.cancel()
    assert (
        "no quaternion (0x121) arrives, though sample_time (0x005), group_counter (0x006)" in told
    )
    assert "the data of 0x021 look like a quaternion: set `ids.quaternion` to it" in told


async def send_on(device: XcdiDevice) -> None:
    number = 0
    while True:
        number += 1
        device.push(number * 10_000_000, IDENTITY)
        await asyncio.sleep(0.01)


async def test_a_quaternion_that_stops_is_missed_though_time_and_counter_go_on(
    tmp_path: Path,
) -> None:
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)
    async with serving(adapter):
        run = DriverRun(xcdi_driver("S3", bus, silence_s=0.5))
        await opened(adapter)
        for number in range(200):
            if run.task.done():
                break
            time_and_counter = [
                CanFrame(0, 0x05, number.to_bytes(4, "big")),
                CanFrame(0, 0x06, number.to_bytes(2, "big")),
            ]
            adapter.send(time_and_counter)
            if number < 5:
                adapter.send([CanFrame(0, 0x21, bytes.fromhex("7fff000000000000"))])
            await asyncio.sleep(0.01)
        told = await lost(run)
        assert len(run.samples) == 5
    assert (
        "no quaternion (0x021) arrives, though sample_time (0x005), group_counter (0x006) do"
        in told
    )


async def test_one_identifier_for_two_devices_names_both(tmp_path: Path) -> None:
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)
    device = XcdiDevice(adapter)
    async with serving(device):
        first = DriverRun(xcdi_driver("S3", bus))
        await opened(adapter)
        with pytest.raises(DeviceMisconfiguredError, match=r"0x\d+.*S3.*identifiers of its own"):
            await DriverRun(xcdi_driver("S4", bus)).task
        device.push(0, IDENTITY)
        await first.wait_for(1)
        await first.cancel()


async def test_lost_bytes_of_a_line_are_counted_by_one_device_only(tmp_path: Path) -> None:
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)
    async with serving(adapter):
        runs = [DriverRun(xcdi_driver("S3", bus, 0x100)), DriverRun(xcdi_driver("S4", bus, 0x200))]
        await opened(adapter)
        adapter._line.write(b"what is this\r")
        await asyncio.sleep(0.1)
        found = [event for run in runs for event in run.events]
        assert found == [Corrupt(13, "no SLCAN line")]
        for run in runs:
            await run.cancel()


async def test_a_bug_of_one_device_does_not_affect_other_devices(tmp_path: Path) -> None:
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)
    devices = two_sensors(adapter)

    def emit(_: Chunk) -> None:
        raise ZeroDivisionError

    async with serving(*devices):
        good = DriverRun(xcdi_driver("S3", bus, 0x100))
        bad = asyncio.create_task(xcdi_driver("S4", bus, 0x200).run(emit))
        await opened(adapter)
        for device in devices:
            device.push(0, IDENTITY)
        with pytest.raises(ZeroDivisionError):
            await bad
        await good.wait_for(1)
        await good.cancel()


async def test_bit_rate_is_sent_to_the_adapter(tmp_path: Path) -> None:
    adapter = SlcanAdapter(tmp_path / "adapter")
    async with serving(adapter):
        run = DriverRun(xcdi_driver("S3", bus_at(tmp_path, bitrate=250_000)))
        await opened(adapter)
        assert adapter.bitrate == 250_000
        await run.cancel()


def test_a_bit_rate_slcan_does_not_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match=r"not a bit rate of SLCAN.*1000000"):
        bus_at(tmp_path, bitrate=83_333)


async def test_an_adapter_left_streaming_by_a_crash_is_taken_over(tmp_path: Path) -> None:
    adapter, bus = SlcanAdapter(tmp_path / "adapter"), bus_at(tmp_path)
    device = XcdiDevice(adapter)
    async with serving(device):
        run = DriverRun(xcdi_driver("S3", bus))
        await opened(adapter)
        await run.cancel()
        adapter.is_open = True  # the host ended without closing the bus
        for number in range(50):
            device.push(number * 10_000_000, IDENTITY)
        run = DriverRun(xcdi_driver("S3", bus))
        await asyncio.sleep(0.2)
        await opened(adapter)
        device.push(50 * 10_000_000, IDENTITY)
        await run.wait_for(1)
        assert [each.counter for each in run.samples] == [50], "a stale frame"
        await run.cancel()


class Chatter:
    """GPS receiver that sends continuously and ignores its input."""

    def __init__(self, link: Path) -> None:
        self._line = PtyLine(link)
        self.unplug = self._line.unplug

    async def run(self) -> None:
        while True:
            self._line.write(b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M*47\r\n")
            await asyncio.sleep(0.02)


async def test_a_device_with_another_protocol_is_named(tmp_path: Path) -> None:
    async with serving(Chatter(tmp_path / "adapter")):
        with pytest.raises(DeviceMisconfiguredError, match="no SLCAN adapter found at 115200 baud"):
            await xcdi_driver("S3", bus_at(tmp_path)).run(lambda _: None)
