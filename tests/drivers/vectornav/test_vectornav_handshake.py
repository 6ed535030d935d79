"""Handshake of the VectorNav driver with simulated devices, for every setting and fault."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from typing_extensions import override

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import DeviceEvent
from jointfit_drivers.vectornav import VectorNavImu
from jointfit_simulators.devices import VectorNavDevice, VectorNavDeviceOptions
from tests.drivers.driver_run import DriverRun, serving
from tests.drivers.vectornav.vectornav_messages import settings

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.real_time
READY = VectorNavDeviceOptions(outputs=((3, 8, (0x00, 0x04)),), text_output="")


async def run_for(driver: VectorNavImu, count: int = 5) -> DriverRun:
    run = DriverRun(driver)
    try:
        await run.wait_for(count)
    finally:
        await run.cancel()
    return run


async def refusal(driver: VectorNavImu, kind: type[Exception] = DeviceMisconfiguredError) -> str:
    with pytest.raises(kind) as caught:
        async with asyncio.timeout(20):
            await driver.run(lambda _: None)
    return str(caught.value)


async def test_a_device_that_is_right_is_not_written_to(tmp_path: Path) -> None:
    device = VectorNavDevice(tmp_path / "imu", options=READY)
    async with serving(device, feeding=True):
        run = await run_for(VectorNavImu(settings(tmp_path, persist=True)))
    assert (device.writes, device.stores) == (0, 0)
    known = {key for one in run.events if isinstance(one, DeviceEvent) for key in one.data}
    assert {"model", "serial", "firmware", "reference_frame", "output_1"} <= known


async def test_differences_are_written_and_stored_only_with_persist(tmp_path: Path) -> None:
    device = VectorNavDevice(tmp_path / "imu")
    async with serving(device, feeding=True):
        run = await run_for(VectorNavImu(settings(tmp_path)))
        assert (device.writes, device.stores) == (2, 0)
        assert device.rate_hz == 100
        assert device.text_output == ""
        device.power_cycle()
        await run_for(VectorNavImu(settings(tmp_path, persist=True)))
        assert (device.writes, device.stores) == (4, 1)
        device.power_cycle()
        await run_for(VectorNavImu(settings(tmp_path, persist=True, output=1)))
    assert (device.writes, device.stores) == (4, 1)
    assert all(sample.ticks is not None for sample in run.samples)


async def test_another_binary_output_can_be_used(tmp_path: Path) -> None:
    options = VectorNavDeviceOptions(outputs=((3, 80, (0x03,)),), text_output="")
    device = VectorNavDevice(tmp_path / "imu", options=options)
    async with serving(device, feeding=True):
        await run_for(VectorNavImu(settings(tmp_path, output=3)))
    assert device.outputs[75].divisor == 80
    assert device.outputs[77].divisor == 8


async def test_a_rate_that_is_no_fraction_is_refused_with_those_that_are(tmp_path: Path) -> None:
    device = VectorNavDevice(tmp_path / "imu", options=READY)
    async with serving(device, feeding=True):
        text = await refusal(VectorNavImu(settings(tmp_path, rate_hz=120)))
        await asyncio.sleep(0.05)
        assert device.streaming, "it continues as before"
    assert "120 Hz is not the 800 Hz of VN-100S-CR divided by an integer" in text
    assert "set rate_hz to one of 800, 400, 200, 160" in text


async def test_a_field_that_the_model_lacks_is_refused_by_the_device(tmp_path: Path) -> None:
    options = VectorNavDeviceOptions(missing_fields=(0x04,))
    async with serving(VectorNavDevice(tmp_path / "imu", options=options)):
        text = await refusal(VectorNavImu(settings(tmp_path)))
    assert "error 7, invalid parameter" in text


async def test_a_wrong_speed_is_named_with_the_right_one(tmp_path: Path) -> None:
    options = VectorNavDeviceOptions(outputs=READY.outputs, text_output="", baud=921_600)
    device = VectorNavDevice(tmp_path / "imu", options=options)
    async with serving(device, feeding=True):
        text = await refusal(VectorNavImu(settings(tmp_path)))
        await asyncio.sleep(0.05)
        assert device.streaming
    assert "set baud = 921600" in text


async def test_a_device_that_streams_but_does_not_answer_is_lost(tmp_path: Path) -> None:
    class Deaf(VectorNavDevice):
        @override
        def _receive(self, data: bytes) -> None:
            """Ignore the host."""

    async with serving(Deaf(tmp_path / "imu", options=READY), feeding=True):
        text = await refusal(VectorNavImu(settings(tmp_path)), DeviceLostError)
    assert "wire from host to device" in text
