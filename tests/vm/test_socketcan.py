"""The XCDI driver on real SocketCAN: filters, stamps, overflow, and interfaces that disappear.

The tests need an interface vcan0 that may be changed. They run in the light virtual machine
(``.ci/light_vm.py``), or as root on any Linux with vcan.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

import pytest
from typing_extensions import override

from jointfit_daemon.driver import CanBusSettings, DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import DeviceEvent
from jointfit_drivers.ports.can_bus import shared_bus
from jointfit_drivers.xcdi import XcdiIdSettings, XcdiImu
from jointfit_protocols.can import HOST_DROPPED, host_count
from jointfit_protocols.xcdi import XcdiIds, id_block
from jointfit_simulators.devices import XcdiDevice, XcdiDeviceOptions
from jointfit_simulators.driver_contract import DriverContract
from jointfit_simulators.wires import PythonCanWire
from tests.vm.vcan_link import (
    BUS,
    LINK,
    NEEDS_VCAN,
    LinkWire,
    ReceivedFrames,
    RemovableWire,
    identity,
    ip,
    running,
    settings,
)

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

pytestmark = NEEDS_VCAN


class TestXcdiOnVcanThatGoesDown(DriverContract):
    registered_as = "xcdi"

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> XcdiDevice:
        return XcdiDevice(LinkWire())

    @override
    def make_driver(self, folder: Path) -> Driver:
        return XcdiImu(settings())

    # CAN has its own error detection, and devices of any kind may be on a bus.
    test_line_noise_affects_only_damaged_samples = None  # type: ignore[assignment]
    test_wrong_device_raises_device_misconfigured = None  # type: ignore[assignment]


class TestXcdiOnVcanThatIsRemoved(TestXcdiOnVcanThatGoesDown):
    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> XcdiDevice:
        return XcdiDevice(RemovableWire())


async def test_four_sensors_share_one_bus_and_each_gets_its_own(wire: PythonCanWire) -> None:
    """Each driver receives only the frames of its own sensor."""
    bases = {f"S{n}": 0x100 * n for n in range(1, 5)}
    devices = [
        XcdiDevice(wire, XcdiDeviceOptions(ids=id_block(base), first_counter=base))
        for base in bases.values()
    ]
    drivers = [
        XcdiImu(
            settings(
                name,
                ids=XcdiIdSettings(
                    sample_time=base + 5, group_counter=base + 6, quaternion=base + 0x21
                ),
            )
        )
        for name, base in bases.items()
    ]
    async with asyncio.TaskGroup() as group:
        heard = [ReceivedFrames(driver) for driver in drivers]
        tasks = [
            group.create_task(driver.run(each.emit))
            for driver, each in zip(drivers, heard, strict=True)
        ]
        await asyncio.sleep(0.1)
        for number in range(50):
            for device in devices:
                device.push(number * 10_000_000, (1.0, 0.0, 0.0, 0.0))
            await asyncio.sleep(0.002)
        for each in heard:
            await each.wait_for(50)
        for task in tasks:
            task.cancel()
    for each, base in zip(heard, bases.values(), strict=True):
        assert [sample.counter for sample in each.samples] == list(range(base, base + 50))
        codec = each.decoder._xcdi
        assert codec.foreign == codec.incomplete == each.decoder.discarded_bytes == 0
        assert not [
            event for event in each.events if isinstance(event, DeviceEvent) and event.kind == "gap"
        ]


async def test_kernel_filters_pass_only_configured_identifiers(wire: PythonCanWire) -> None:
    driver = XcdiImu(settings())
    other = XcdiDevice(wire, XcdiDeviceOptions(ids=id_block(0x300)))
    async with shared_bus(BUS) as bus, running(driver) as heard:
        device = XcdiDevice(wire)
        identity(device, 1)  # the filters are set after the first sample
        await heard.wait_for(1)
        identity(other, 20)
        identity(device, 20, first=1)
        await heard.wait_for(21)
        assert bus.foreign == 0
        assert heard.decoder._xcdi.foreign == 0


async def test_29_bit_identifiers_are_not_taken_for_11_bit_ones(wire: PythonCanWire) -> None:
    driver = XcdiImu(settings(extended_ids=True))
    async with running(driver) as heard:
        identity(XcdiDevice(wire), 5)
        identity(XcdiDevice(wire, XcdiDeviceOptions(ids=XcdiIds(extended=True))), 20)
        await heard.wait_for(20)
        assert len(heard.samples) == 20
        assert all(frame.extended for frame in heard.frames)


async def test_stamps_are_the_kernels_not_those_of_the_read(wire: PythonCanWire) -> None:
    async with running(XcdiImu(settings())) as heard:
        device = XcdiDevice(wire)
        identity(device, 1)
        await heard.wait_for(1)
        before = time.monotonic_ns()
        identity(device, 10, first=1)
        after = time.monotonic_ns()
        time.sleep(0.2)  # noqa: ASYNC251 - the loop is to stall
        await heard.wait_for(11)
        slack = 1_000_000  # errors of back-dating and of clock conversion
        stamps = [sample.arrival_ns for sample in heard.samples[1:]]
        assert all(before - slack <= stamp <= after + slack for stamp in stamps)
        assert stamps == sorted(stamps)


async def test_frames_that_the_kernel_dropped_are_counted_exactly(wire: PythonCanWire) -> None:
    async with running(XcdiImu(settings(silence_s=10))) as heard:
        device, burst = XcdiDevice(wire), 3000
        # The event loop does not run during the burst, so one queue receives 12 000 frames.
        identity(device, burst)

        def arrived() -> int:
            return sum(not frame.error for frame in heard.frames)

        seen = 0
        while not seen or seen != arrived():  # until the queue is empty
            seen = arrived()
            await asyncio.sleep(0.3)  # the driver reads the kernel's counter every 0.25 s
        identity(device, 1, first=burst)
        dropped = 0
        async with asyncio.timeout(10):
            while arrived() + dropped < 4 * (burst + 1):
                await asyncio.sleep(0.05)
                dropped = sum(host_count(f) for f in heard.frames if f.can_id == HOST_DROPPED)
        assert dropped > 0
        assert arrived() + dropped == 4 * (burst + 1)
        told = [
            e.data["dropped_frames"]
            for e in heard.events
            if "kernel dropped" in getattr(e, "text", "")
        ]
        assert sum(told) == dropped


async def test_link_that_is_down_is_reported_with_a_remedy() -> None:
    ip("set", LINK, "down")
    with pytest.raises(DeviceLostError, match=f"ip link set {LINK} up"):
        async with asyncio.timeout(2):
            await XcdiImu(settings(silence_s=1.5)).run(lambda _: None)


async def test_every_device_is_lost_when_the_link_goes_down_and_all_come_back() -> None:
    names = ["S3", "S4"]
    drivers = [
        XcdiImu(settings("S3", silence_s=5)),
        XcdiImu(
            settings(
                "S4",
                silence_s=5,
                ids=XcdiIdSettings(sample_time=0x205, group_counter=0x206, quaternion=0x221),
            )
        ),
    ]
    tasks = [asyncio.create_task(driver.run(lambda _: None)) for driver in drivers]
    await asyncio.sleep(0.1)
    ip("set", LINK, "down")
    began = time.monotonic()
    await asyncio.wait(tasks, timeout=2)
    assert time.monotonic() - began < 1
    assert [type(task.exception()) for task in tasks] == [DeviceLostError] * len(names)
    ip("set", LINK, "up")
    wire = PythonCanWire("socketcan", LINK)
    try:
        async with running(drivers[0]) as heard:
            identity(XcdiDevice(wire), 10)
            await heard.wait_for(10)
    finally:
        wire.unplug()


async def test_an_interface_that_is_not_there_is_lost_not_fatal() -> None:
    bus = CanBusSettings(interface="socketcan", channel="can9")
    with pytest.raises(DeviceLostError, match="can9: no such CAN interface"):
        await XcdiImu(settings().model_copy(update={"can": bus})).run(lambda _: None)


async def test_a_silent_sensor_is_lost_alone_on_a_live_bus(wire: PythonCanWire) -> None:
    silent = XcdiImu(
        settings("S4", ids=XcdiIdSettings(sample_time=0x205, group_counter=0x206, quaternion=0x221))
    )
    async with running(XcdiImu(settings())) as heard:
        device = XcdiDevice(wire)
        task = asyncio.create_task(silent.run(lambda _: None))
        for number in range(80):
            identity(device, 1, first=number)
            await asyncio.sleep(0.01)
        missing = r"no quaternion \(0x221\) arrives, while other sensors send"
        with pytest.raises(DeviceLostError, match=missing):
            await task
        assert len(heard.samples) == 80


async def test_two_sensors_with_one_identifier_are_refused_by_name(wire: PythonCanWire) -> None:
    async with running(XcdiImu(settings("S3"))):
        with pytest.raises(DeviceMisconfiguredError, match=r"0x.*also used by S3"):
            await XcdiImu(settings("S4")).run(lambda _: None)
