"""Handshake of the MIP driver with simulated devices, for every setting and fault."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import DeviceEvent
from jointfit_drivers.mip import MipImu
from jointfit_protocols.mip.commands import Base, CommandSet, DeviceInformation, encode_command
from jointfit_simulators.devices import MipDevice, MipDeviceOptions
from tests.drivers.driver_run import DriverRun, serving
from tests.drivers.mip.mip_packets import settings

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.real_time
READY = MipDeviceOptions(formats=((0x82, ((0xD5, 5), (0x03, 5))),), streams=(0x82,))


async def run_for(driver: MipImu, count: int = 5) -> DriverRun:
    run = DriverRun(driver)
    try:
        await run.wait_for(count)
    finally:
        await run.cancel()
    return run


async def refusal(driver: MipImu, kind: type[Exception] = DeviceMisconfiguredError) -> str:
    with pytest.raises(kind) as caught:
        async with asyncio.timeout(20):
            await driver.run(lambda _: None)
    return str(caught.value)


async def test_a_device_that_is_right_is_not_written_to(tmp_path: Path) -> None:
    device = MipDevice(tmp_path / "imu", options=READY)
    async with serving(device, feeding=True):
        run = await run_for(MipImu(settings(tmp_path, persist=True)))
    assert (device.writes, device.saves) == (0, 0)
    first, *_ = run.events
    known = {key for one in run.events if isinstance(one, DeviceEvent) for key in one.data}
    assert {"model", "serial", "firmware", "sensor_to_vehicle", "outputs_0x82"} <= known
    assert isinstance(first, DeviceEvent), "a packet from before the acknowledgement"


@pytest.mark.parametrize("family", ["current", "legacy"])
@pytest.mark.parametrize("names_descriptors", [True, False])
async def test_differences_are_written_and_saved_only_with_persist(
    tmp_path: Path, family: Any, names_descriptors: bool
) -> None:
    name = "3DM-GX5-25" if family == "legacy" else "3DM-CV7-AHRS"
    info = DeviceInformation(1000, name, "", "", "", "")
    options = MipDeviceOptions(info=info, family=family, names_descriptors=names_descriptors)
    device = MipDevice(tmp_path / "imu", options=options)
    async with serving(device, feeding=True):
        run = await run_for(MipImu(settings(tmp_path)))
        assert (device.writes, device.saves) == (2, 0)
        assert device.rate_hz == 100
        device.power_cycle()
        await run_for(MipImu(settings(tmp_path, persist=True)))
        assert (device.writes, device.saves) == (4, 1)
        device.power_cycle()
        await run_for(MipImu(settings(tmp_path, persist=True)))
    assert (device.writes, device.saves) == (4, 1)
    assert all(sample.ticks is not None for sample in run.samples)


async def test_one_decimation_for_orientation_and_time(tmp_path: Path) -> None:
    """If their decimations differ, the driver sets one decimation for both fields."""
    options = MipDeviceOptions(formats=((0x82, ((0xD5, 50), (0x03, 5))),), streams=(0x82,))
    device = MipDevice(tmp_path / "imu", options=options)
    async with serving(device, feeding=True):
        run = await run_for(MipImu(settings(tmp_path)), 20)
    assert device.writes == 1
    assert all(sample.ticks is not None for sample in run.samples)


async def test_a_rate_that_is_no_fraction_is_refused_with_those_that_are(tmp_path: Path) -> None:
    device = MipDevice(tmp_path / "imu", options=READY)
    async with serving(device, feeding=True):
        text = await refusal(MipImu(settings(tmp_path, rate_hz=120)))
        await asyncio.sleep(0.05)
        assert device.streaming, "it continues as before"
    assert "120 Hz is not the 500 Hz" in text
    assert "500, 250, 125, 100" in text


async def test_a_missing_orientation_is_named_with_the_other_estimator(tmp_path: Path) -> None:
    options = MipDeviceOptions(missing_fields=((0x82, 0x03),))
    async with serving(MipDevice(tmp_path / "imu", options=options)):
        text = await refusal(MipImu(settings(tmp_path)))
    assert "3DM-CV7-AHRS does not measure 0x82,0x03" in text
    assert 'estimator = "sensor" or orientation = "gateway"' in text


async def test_the_wrong_family_is_refused_by_the_device(tmp_path: Path) -> None:
    async with serving(MipDevice(tmp_path / "imu")):
        text = await refusal(MipImu(settings(tmp_path, family="legacy")))
    assert "code 1, unknown command" in text


async def test_a_wrong_speed_is_named_with_the_right_one(tmp_path: Path) -> None:
    options = MipDeviceOptions(formats=READY.formats, streams=READY.streams, baud=921_600)
    device = MipDevice(tmp_path / "imu", options=options)
    async with serving(device, feeding=True):
        text = await refusal(MipImu(settings(tmp_path)))
        await asyncio.sleep(0.05)
        assert device.streaming
    assert "set baud = 921600" in text


async def test_a_line_too_slow_for_the_rate_is_refused(tmp_path: Path) -> None:
    async with serving(MipDevice(tmp_path / "imu")):
        text = await refusal(MipImu(settings(tmp_path, rate_hz=500, baud=9_600)))
    assert "500 Hz need" in text


async def test_a_device_that_streams_but_does_not_answer_is_lost(tmp_path: Path) -> None:
    class Deaf(MipDevice):
        @override
        def _receive(self, data: bytes) -> None:
            """Ignore the host."""

    async with serving(Deaf(tmp_path / "imu", options=READY), feeding=True):
        text = await refusal(MipImu(settings(tmp_path)), DeviceLostError)
    assert "wire from host to device" in text


async def test_a_changed_speed_takes_effect_after_a_silence(tmp_path: Path) -> None:
    options = MipDeviceOptions(formats=READY.formats, streams=READY.streams, baud=115_200)
    device = MipDevice(tmp_path / "imu", options=options)
    async with serving(device, feeding=True):
        run = DriverRun(MipImu(settings(tmp_path)))
        await run.wait_for(5)
        speed = b"\x01\x01" + (921_600).to_bytes(4, "big")
        device._receive(encode_command(CommandSet.BASE, Base.PORT_SPEED, speed))
        await asyncio.sleep(0.05)
        sent = device.sent
        await asyncio.sleep(0.15)
        assert device.sent == sent
        await asyncio.sleep(0.15)
        assert device.baud == 921_600
        await run.cancel()
