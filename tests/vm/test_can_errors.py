"""Error frames and bus-off on real SocketCAN, as a controller's driver reports them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import can
import pytest

from jointfit_daemon.driver import DeviceLostError
from jointfit_daemon.model import DeviceEvent
from jointfit_drivers.xcdi import XcdiImu
from jointfit_simulators.devices import XcdiDevice
from tests.vm.vcan_link import NEEDS_VCAN, ReceivedFrames, identity, running, settings

if TYPE_CHECKING:
    from jointfit_simulators.wires import PythonCanWire

pytestmark = NEEDS_VCAN


def error_frame(wire: PythonCanWire, kind: int, data: bytes = bytes(8)) -> None:
    """Send an error frame through the kernel, like the driver of a CAN controller."""
    assert wire._bus is not None
    wire._bus.send(
        can.Message(
            arbitration_id=kind, is_error_frame=True, is_extended_id=False, data=data, dlc=8
        )
    )


def errors_of(heard: ReceivedFrames) -> list[DeviceEvent]:
    return [e for e in heard.events if isinstance(e, DeviceEvent) and e.kind == "error"]


@pytest.mark.parametrize(
    ("kind", "data", "told"),
    [
        (0x040, bytes(8), "bus off"),
        (0x004, bytes([0, 0x10, 0, 0, 0, 0, 0, 0]), "error passive"),
        (0x004, bytes([0, 0x01, 0, 0, 0, 0, 0, 0]), "receive overflow"),
        (0x020, bytes(8), "no acknowledgment"),
    ],
)
async def test_controller_errors_pass_the_filters_and_are_reported_once(
    wire: PythonCanWire, kind: int, data: bytes, told: str
) -> None:
    async with running(XcdiImu(settings())) as heard:
        device = XcdiDevice(wire)
        identity(device, 5)
        error_frame(wire, kind, data)
        identity(device, 5, first=5)
        await heard.wait_for(10)
        (event,) = errors_of(heard)
        assert told in event.text
        assert [sample.counter for sample in heard.samples] == list(range(10))


async def test_after_bus_off_the_silence_is_a_loss_and_a_restart_brings_the_sensor_back(
    wire: PythonCanWire,
) -> None:
    driver = XcdiImu(settings())
    heard = ReceivedFrames(driver)
    task = asyncio.create_task(driver.run(heard.emit))
    await asyncio.sleep(0.05)
    identity(XcdiDevice(wire), 5)
    await heard.wait_for(5)
    for _ in range(20):  # only error frames, which do not end the silence of the sensor
        error_frame(wire, 0x040)
        await asyncio.sleep(0.05)
    with pytest.raises(DeviceLostError, match=r"silent: check its power"):
        await task
    assert "bus off" in errors_of(heard)[0].text
    async with running(XcdiImu(settings())) as again:
        error_frame(wire, 0x100)
        identity(XcdiDevice(wire), 5)
        await again.wait_for(5)
