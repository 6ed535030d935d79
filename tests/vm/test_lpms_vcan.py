"""The driver of LPMS sensors on real SocketCAN: both modes, both precisions, and other sensors.

The tests need an interface vcan0 that may be changed, see test_socketcan.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.tools.discovery import listen_can
from jointfit_drivers.lpms import LpmsCanImu, LpmsCanSettings
from jointfit_drivers.xcdi import XcdiImu
from jointfit_protocols.lpms.channels import sequential_ids, tpdo_ids
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import LpmsCanDevice, LpmsCanDeviceOptions, XcdiDevice
from jointfit_simulators.driver_contract import DriverContract
from tests.vm.vcan_link import BUS, LINK, NEEDS_VCAN, LinkWire, running
from tests.vm.vcan_link import settings as xcdi_settings

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise
    from jointfit_simulators.wires import PythonCanWire

pytestmark = NEEDS_VCAN


def lpms_settings(
    numbers: tuple[int, ...], mode: str = "canopen", precision: str = "int16", name: str = "S3"
) -> LpmsCanSettings:
    ids = {f"frame{k}": number for k, number in enumerate(numbers, 1)}
    table: dict[str, Any] = {"id": name, "segment": "shank", "driver": "lpms-can", "can": BUS}
    # A low rate: the machine may pause between two frames of a sample for more than 5 ms.
    table |= {"rate_hz": 10, "silence_s": 0.5}
    return LpmsCanSettings.model_validate(
        {**table, "mode": mode, "ids": ids, "precision": precision}
    )


class TestLpmsOnVcanThatGoesDown(DriverContract):
    registered_as = "lpms-can"

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> LpmsCanDevice:
        options = LpmsCanDeviceOptions(
            mode="sequential", ids=sequential_ids(1, spaced=False), precision="float32"
        )
        return LpmsCanDevice(LinkWire(), options)

    @override
    def make_driver(self, folder: Path) -> Driver:
        numbers = sequential_ids(1, spaced=False)
        return LpmsCanImu(lpms_settings(numbers, "sequential", "float32"))

    # CAN has its own error detection, and devices of any kind may be on a bus.
    test_line_noise_affects_only_damaged_samples = None  # type: ignore[assignment]
    test_wrong_device_raises_device_misconfigured = None  # type: ignore[assignment]


async def test_four_nodes_and_another_family_share_one_bus(wire: PythonCanWire) -> None:
    nodes = {1: "int16", 2: "float32", 3: "int16", 4: "float32"}
    devices: list[Any] = [
        LpmsCanDevice(wire, LpmsCanDeviceOptions(node=node, precision=precision))  # type: ignore[arg-type]
        for node, precision in nodes.items()
    ]
    drivers: list[Driver] = [
        LpmsCanImu(lpms_settings(tpdo_ids(node), precision=precision, name=f"S{node}"))
        for node, precision in nodes.items()
    ]
    devices.append(XcdiDevice(wire))
    drivers.append(XcdiImu(xcdi_settings("S9")))

    async with AsyncExitStack() as stack:
        found = [await stack.enter_async_context(running(driver)) for driver in drivers]
        for number in range(50):
            for device in devices:
                device.push(number * 10_000_000, orientation(number))
            await asyncio.sleep(0.002)
        for received in found:
            await received.wait_for(50)
    for received in found:
        assert len(received.samples) == 50
        assert received.decoder.discarded_bytes == 0


async def test_stamps_are_the_kernels_because_the_sensor_sends_no_time(
    wire: PythonCanWire,
) -> None:
    async with running(LpmsCanImu(lpms_settings(tpdo_ids(1)))) as received:
        device = LpmsCanDevice(wire)
        device.push(0, orientation(0))
        await received.wait_for(1)
        before = time.monotonic_ns()
        for number in range(1, 11):
            device.push(number * 10_000_000, orientation(number))
        after = time.monotonic_ns()
        time.sleep(0.2)  # noqa: ASYNC251 - the loop is to stall
        await received.wait_for(11)
        stamps = [sample.arrival_ns for sample in received.samples[1:]]
        assert all(before - 1_000_000 <= stamp <= after + 1_000_000 for stamp in stamps)


async def test_neighbours_with_overlapping_identifiers_are_refused(wire: PythonCanWire) -> None:
    first, second = (sequential_ids(node, spaced=False) for node in (1, 2))
    async with running(LpmsCanImu(lpms_settings(first, "sequential"))):
        with pytest.raises(DeviceMisconfiguredError, match="also used by S3"):
            await LpmsCanImu(lpms_settings(second, "sequential", name="S4")).run(lambda _: None)


async def test_a_sensor_that_sends_heartbeats_alone_is_lost_by_name(wire: PythonCanWire) -> None:
    device = LpmsCanDevice(wire, LpmsCanDeviceOptions(heartbeat_hz=100))
    for index in range(4):
        device.lose_frames(index, 1000)

    async def beat() -> None:
        for number in range(100):
            device.push(number * 10_000_000, orientation(number))
            await asyncio.sleep(0.01)

    task = asyncio.create_task(beat())
    with pytest.raises(DeviceLostError, match=r"no frame1 \(0x181\) arrives, though heartbeat"):
        await LpmsCanImu(lpms_settings(tpdo_ids(1))).run(lambda _: None)
    await task


async def test_probe_recognizes_both_modes(wire: PythonCanWire) -> None:
    sensors = [
        LpmsCanDevice(wire),
        LpmsCanDevice(
            wire, LpmsCanDeviceOptions(mode="sequential", ids=sequential_ids(1, spaced=True))
        ),
    ]
    listening = asyncio.create_task(asyncio.to_thread(listen_can, LINK, listen_s=1.0))
    while not listening.done():
        for sensor in sensors:
            sensor.push(time.monotonic_ns(), orientation(1))
        await asyncio.sleep(0.01)
    found = (await listening).devices
    assert [(each.driver, each.settings["mode"]) for each in found] == [
        ("lpms-can", "canopen"), ("lpms-can", "sequential"),
    ]  # fmt: skip
