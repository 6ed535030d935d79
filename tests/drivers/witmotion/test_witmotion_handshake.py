"""The WitMotion driver with differently configured devices, and the settings that it writes."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from pydantic import ValidationError

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.witmotion import WitMotionImu, WitMotionSettings
from jointfit_protocols.witmotion import RATE_CODES, UNLOCK, WitMotionRegister, write_register
from jointfit_simulators.devices import WitMotionDevice, WitMotionDeviceOptions
from jointfit_simulators.devices._witmotion_device import FACTORY_CONTENT, WITH_QUATERNION
from tests.drivers.driver_run import DriverRun, serving

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.real_time


def make(folder: Path, **more: Any) -> WitMotionImu:
    table: dict[str, Any] = {"id": "S1", "segment": "thigh", "driver": "witmotion"}
    table |= {"port": str(folder / "imu"), "silence_s": 0.5} | more
    return WitMotionImu(WitMotionSettings(**table))


def device(folder: Path, **options: Any) -> WitMotionDevice:
    return WitMotionDevice(folder / "imu", options=WitMotionDeviceOptions(**options))


async def start(folder: Path, imu: WitMotionDevice, **more: Any) -> None:
    """Run the driver until ten samples have arrived."""
    async with serving(imu, feeding=True):
        run = DriverRun(make(folder, **more))
        await run.wait_for(10)
        await run.cancel()


async def refusal(folder: Path, imu: WitMotionDevice, kind: type[Exception], **more: Any) -> str:
    async with serving(imu, feeding=True):
        with pytest.raises(kind) as caught:
            async with asyncio.timeout(20):
                await make(folder, **more).run(lambda _: None)
    return str(caught.value)


async def test_a_configured_device_is_not_written(tmp_path: Path) -> None:
    imu = device(tmp_path, content=WITH_QUATERNION | FACTORY_CONTENT, rate_hz=100)
    before = dict(imu.registers)
    await start(tmp_path, imu)
    assert imu.registers == before
    assert imu.saved == 0


@pytest.mark.parametrize("persist", [False, True])
async def test_a_factory_device_is_configured_and_flash_is_written_only_with_persist(
    tmp_path: Path, persist: bool
) -> None:
    imu = device(tmp_path)
    await start(tmp_path, imu, persist=persist)
    assert imu.registers[WitMotionRegister.CONTENT] == WITH_QUATERNION
    assert imu.registers[WitMotionRegister.RATE] == RATE_CODES[100]
    assert imu.saved == persist
    imu.power_cycle()
    assert (imu.registers[WitMotionRegister.CONTENT] == WITH_QUATERNION) == persist


async def test_a_device_at_its_factory_speed_is_found_and_moved_only_with_persist(
    tmp_path: Path,
) -> None:
    text = await refusal(tmp_path, device(tmp_path, baud=9_600), DeviceMisconfiguredError)
    assert "115200 baud, but no frame can be decoded; the device sends at 9600" in text
    assert "set baud = 9600 and rate_hz = 50, or persist = true once" in text

    imu = device(tmp_path, baud=9_600)
    await start(tmp_path, imu, persist=True)
    assert imu.flash[WitMotionRegister.BAUD] == 0x06


async def test_the_bluetooth_variant_is_refused_with_its_name(tmp_path: Path) -> None:
    text = await refusal(tmp_path, device(tmp_path, bluetooth=True), DeviceMisconfiguredError)
    assert "frames 55 61" in text


async def test_a_device_that_ignores_commands_is_refused_with_what_it_sends(
    tmp_path: Path,
) -> None:
    imu = device(tmp_path, ignores_commands=True)
    text = await refusal(tmp_path, imu, DeviceMisconfiguredError)
    assert "acceleration, rate, angle, magnetic field, no quaternion, even on request" in text


async def test_a_silent_port_is_a_lost_device(tmp_path: Path) -> None:
    imu = device(tmp_path, ignores_commands=True)
    async with serving(imu):
        with pytest.raises(DeviceLostError, match="no data"):
            await make(tmp_path).run(lambda _: None)


def test_writes_are_accepted_for_ten_seconds_after_the_key(tmp_path: Path) -> None:
    now = 100.0
    imu = WitMotionDevice(tmp_path / "imu", now_s=lambda: now)
    command = write_register(WitMotionRegister.CONTENT, WITH_QUATERNION)
    imu._receive(command)
    assert imu.registers[WitMotionRegister.CONTENT] == FACTORY_CONTENT
    imu._receive(UNLOCK)
    now = 110.0
    imu._receive(command)
    assert imu.registers[WitMotionRegister.CONTENT] == FACTORY_CONTENT
    imu._receive(UNLOCK)
    now = 119.9
    imu._receive(b"\xff" + command)  # a stray byte before the command
    assert imu.registers[WitMotionRegister.CONTENT] == WITH_QUATERNION
    imu.unplug()


def test_settings_are_checked_without_the_device() -> None:
    table: dict[str, Any] = {"id": "S1", "segment": "thigh", "driver": "witmotion", "port": "p"}
    with pytest.raises(ValidationError, match="expected one of 10, 20, 50, 100, 200 Hz, found 60"):
        WitMotionSettings(**table, rate_hz=60)
    with pytest.raises(ValidationError, match="expected the path of a serial port"):
        WitMotionSettings(**table | {"port": "ttyUSB0"})
    assert WitMotionSettings(**table).serial_bits_per_s == 11_000
    pytest.importorskip("vqf")
    raw = WitMotionSettings(**table, orientation="gateway", magnetometer=True, rate_hz=200)
    assert raw.serial_bits_per_s == 88_000
