"""Start of the BNO085 driver in the modes UART-RVC and UART-SHTP, and the settings it changes."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from pydantic import ValidationError

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import DeviceEvent
from jointfit_drivers.bno085 import Bno085Imu, Bno085Settings
from jointfit_protocols.bno085 import HubReportId
from jointfit_simulators.devices import Bno085Device, Bno085DeviceOptions
from tests.drivers.driver_run import DriverRun, serving

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.real_time
TABLE: dict[str, Any] = {"id": "S1", "segment": "thigh", "driver": "bno085", "port": "p"}


def make(folder: Path, baud: int, **more: Any) -> Bno085Imu:
    table = TABLE | {"port": str(folder / "imu"), "baud": baud, "silence_s": 0.5} | more
    return Bno085Imu(Bno085Settings(**table))


def device(folder: Path, **options: Any) -> Bno085Device:
    return Bno085Device(folder / "imu", options=Bno085DeviceOptions(**options))


async def refusal(folder: Path, bno: Bno085Device, baud: int) -> str:
    async with serving(bno, feeding=True):
        with pytest.raises(DeviceMisconfiguredError) as caught:
            async with asyncio.timeout(20):
                await make(folder, baud).run(lambda _: None)
    return str(caught.value)


async def test_the_interval_is_set_once_and_the_firmware_is_reported(tmp_path: Path) -> None:
    bno = device(tmp_path)
    async with serving(bno, feeding=True):
        for _ in range(2):
            run = DriverRun(make(tmp_path, 3_000_000))
            await run.wait_for(5)
            await run.cancel()
            assert bno.intervals == {HubReportId.ROTATION_VECTOR: 10_000}
            infos = [item.text for item in run.events if isinstance(item, DeviceEvent)]
            assert infos[0] == "firmware 3.12.4, part_number 10004148, build 230"


async def test_raw_readings_enable_their_reports(tmp_path: Path) -> None:
    pytest.importorskip("vqf")
    bno = device(tmp_path)
    async with serving(bno, feeding=True):
        run = DriverRun(make(tmp_path, 3_000_000, orientation="gateway", settle_s=0, rate_hz=200))
        await run.wait_for(5)
        await run.cancel()
    assert bno.intervals == {0x01: 5_000, 0x07: 5_000}


async def test_gyro_rotation_vectors_are_enabled_and_arrive(tmp_path: Path) -> None:
    bno = device(tmp_path)
    async with serving(bno, feeding=True):
        run = DriverRun(make(tmp_path, 3_000_000, report="gyro_rotation_vector"))
        await run.wait_for(5)
        await run.cancel()
    assert bno.intervals == {0x2A: 10_000}


async def test_a_rate_that_the_device_does_not_accept_is_refused(tmp_path: Path) -> None:
    text = await refusal(tmp_path, device(tmp_path, least_interval_us=20_000), 3_000_000)
    assert "report 0x05 is 50 Hz, not 100 Hz: change `rate_hz` or `report`" in text


async def test_the_other_mode_is_named(tmp_path: Path) -> None:
    """The device is in the mode RVC and the driver expects SHTP, or the reverse."""
    text = await refusal(tmp_path, device(tmp_path, mode="rvc", checks_speed=True), 3_000_000)
    assert "the device sends UART-RVC: set baud = 115200" in text
    bno = device(tmp_path, checks_speed=True)
    bno.intervals[5] = 10_000
    text = await refusal(tmp_path, bno, 115_200)
    assert "bytes at 115200 baud, but no UART-RVC frame" in text
    assert "for UART-SHTP set baud = 3000000" in text


async def test_a_silent_line_is_a_lost_device(tmp_path: Path) -> None:
    bno = device(tmp_path, mode="rvc")
    async with serving(bno):
        with pytest.raises(DeviceLostError, match="PS0 is high and PS1 is low"):
            await make(tmp_path, 115_200).run(lambda _: None)
        with pytest.raises(DeviceLostError, match="PS1 is high and PS0 is low"):
            await make(tmp_path, 3_000_000).run(lambda _: None)


def test_settings_are_checked_without_the_device() -> None:
    with pytest.raises(ValidationError, match="9600 is no speed of a BNO085"):
        Bno085Settings(**TABLE, baud=9600)
    with pytest.raises(ValidationError, match="UART-RVC sends 100 Hz"):
        Bno085Settings(**TABLE, rate_hz=50)
    with pytest.raises(ValidationError, match="expected at most 400 Hz, found 500"):
        Bno085Settings(**TABLE, baud=3_000_000, rate_hz=500)
    pytest.importorskip("vqf")
    with pytest.raises(ValidationError, match="UART-RVC sends no rates of turn"):
        Bno085Settings(**TABLE, orientation="gateway")
