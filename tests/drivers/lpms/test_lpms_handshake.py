"""The handshake of LPMS sensors: settings that are read and changed, and errors."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from pydantic import ValidationError

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import DeviceEvent
from jointfit_drivers.lpms import LpmsImu, LpmsSettings
from jointfit_drivers.lpms import _conversation as conversation
from jointfit_protocols.lpms.configuration import (
    GENERATION_1,
    GENERATION_3,
    TABLES,
    LpmsConfiguration,
)
from jointfit_simulators.devices import LpmsDevice, LpmsDeviceOptions, XbusDevice, XbusDeviceOptions
from tests.drivers.driver_run import DriverRun, serving

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_simulators.imu_device import ImuDevice

pytestmark = pytest.mark.real_time

WRITES = {
    table.generation: {
        table.set_outputs, table.set_rate, table.set_precision, table.store, table.factory_reset,
    }
    for table in TABLES.values()
}  # fmt: skip


@pytest.fixture(autouse=True)
def short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conversation, "MODE_S", 0.3)


def make(folder: Path, **more: Any) -> LpmsImu:
    table: dict[str, Any] = {"generation": 3, "baud": 115_200, "silence_s": 0.5} | more
    port = str(folder / "imu")
    return LpmsImu(LpmsSettings(id="S1", segment="thigh", driver="lpms", port=port, **table))


def device_on(folder: Path, **options: Any) -> LpmsDevice:
    return LpmsDevice(folder / "imu", options=LpmsDeviceOptions(**options))


async def sampled(device: LpmsDevice, driver: LpmsImu, count: int = 5) -> DriverRun:
    """Run until `count` samples have arrived; raise the error of the driver, if any."""
    async with serving(device, feeding=True):
        run = DriverRun(driver)
        try:
            await run.wait_for(count)
        finally:
            await run.cancel()
    return run


async def refusal(
    device: ImuDevice, driver: LpmsImu, kind: type[Exception] = DeviceMisconfiguredError
) -> str:
    async with serving(device, feeding=True):
        with pytest.raises(kind) as caught:
            async with asyncio.timeout(20):
                await driver.run(lambda _: None)
    return str(caught.value)


def properties(run: DriverRun) -> dict[str, object]:
    infos = [e for e in run.events if isinstance(e, DeviceEvent) and e.kind == "info"]
    return {key: value for event in infos for key, value in event.data.items()}


@pytest.mark.parametrize("generation", [1, 3])
async def test_a_sensor_that_is_right_is_only_read(tmp_path: Path, generation: Any) -> None:
    right = LpmsConfiguration(TABLES[generation].quaternion, 100, floats=True)
    device = device_on(tmp_path, generation=generation, configuration=right)
    run = await sampled(device, make(tmp_path, generation=generation, persist=True))
    assert not WRITES[generation] & {*device.commands}
    assert device.flash_writes == 0
    known = properties(run)
    assert known["outputs"] == ["quaternion"]
    assert (known["rate_hz"], known["precision"], known["firmware"]) == (100, "float32", "2.0.6")


@pytest.mark.parametrize("generation", [1, 3])
@pytest.mark.parametrize("precision", ["float32", "int16"])
async def test_differences_are_set_and_lost_with_power(
    tmp_path: Path, generation: Any, precision: str
) -> None:
    """Without `persist`, different settings are changed until the next power cycle only."""
    device = device_on(tmp_path, generation=generation)
    before = device.flash
    run = await sampled(device, make(tmp_path, generation=generation, precision=precision))
    wanted = LpmsConfiguration(TABLES[generation].quaternion, 100, precision == "float32")
    assert device.configuration == wanted
    assert (device.flash, device.flash_writes) == (before, 0)
    assert run.decoder.discarded_bytes == 0
    device.power_cycle()
    assert device.configuration == before


@pytest.mark.parametrize("generation", [1, 3])
async def test_persist_stores_them_once(tmp_path: Path, generation: Any) -> None:
    """With `persist`, different settings are stored in flash memory, at the first start only."""
    device = device_on(tmp_path, generation=generation)
    await sampled(device, make(tmp_path, generation=generation, persist=True))
    assert device.flash.outputs == TABLES[generation].quaternion
    device.plug()
    await sampled(device, make(tmp_path, generation=generation, persist=True))
    assert (device.flash_writes, device.factory_resets) == (1, 0)


@pytest.mark.parametrize(("generation", "other"), [(1, 3), (3, 1)])
async def test_the_wrong_generation_is_refused_before_any_harm(
    tmp_path: Path, generation: Any, other: Any
) -> None:
    device = device_on(tmp_path, generation=generation)
    before = device.configuration
    text = await refusal(device, make(tmp_path, generation=other))
    assert f"set generation = {generation}" in text
    assert {*device.commands} <= {0x06, 0x5B}
    assert device.configuration == device.flash == before
    harm = (device.flash_writes, device.factory_resets, device.gyro_calibrations, device.asleep)
    assert harm == (0, 0, 0, False)


async def test_commands_of_the_other_generation_do_harm_in_the_simulator(tmp_path: Path) -> None:
    """A sensor that reports no generation receives the commands of the configured generation."""
    third = device_on(tmp_path, generation=3, identifies=False)
    await refusal(third, make(tmp_path, generation=1), DeviceLostError)
    assert third.flash_writes > 0  # caused by the read command 0x04 of generation 1

    reset = device_on(tmp_path, configuration=LpmsConfiguration(GENERATION_3.quaternion, 50, True))
    reset.streaming = False
    reset._execute(0x05, b"")
    reset.unplug()
    assert reset.factory_resets == 1
    assert reset.flash.rate_hz == 100

    first = device_on(tmp_path, generation=1, streams_at_once=False)
    first._execute(0x16, b"")
    first._execute(0x08, b"")
    first.unplug()
    assert (first.gyro_calibrations, first.asleep) == (1, True)


async def test_firmware_without_acknowledgements_is_verified_by_reading(tmp_path: Path) -> None:
    device = device_on(tmp_path, generation=1, acknowledges=False, firmware="1.3.5")
    run = await sampled(device, make(tmp_path, generation=1))
    assert device.configuration.outputs == GENERATION_1.quaternion
    assert run.decoder.discarded_bytes == 0


async def test_a_rate_that_the_firmware_has_not_is_refused_by_name(tmp_path: Path) -> None:
    device = device_on(tmp_path, refused_rates=(500,))
    assert "refuses" in (text := await refusal(device, make(tmp_path, rate_hz=500, baud=921_600)))
    assert "500 Hz" in text
    silent = device_on(tmp_path, refused_rates=(500,), acknowledges=False)
    assert "does not accept 500 Hz" in await refusal(
        silent, make(tmp_path, rate_hz=500, baud=921_600)
    )


async def test_another_address_is_named(tmp_path: Path) -> None:
    device = device_on(
        tmp_path, sensor_id=7, configuration=LpmsConfiguration(GENERATION_3.quaternion, 100, True)
    )
    assert "set sensor_id = 7" in await refusal(device, make(tmp_path))


async def test_another_speed_is_found_and_named(tmp_path: Path) -> None:
    device = device_on(tmp_path, baud=460_800)
    assert "set baud = 460800" in await refusal(device, make(tmp_path))
    assert device.streaming


async def test_text_output_is_reported_with_its_remedy(tmp_path: Path) -> None:
    device = device_on(tmp_path, text=True)
    text = await refusal(device, make(tmp_path))
    assert "sends text: set its output format to LP-BUS" in text


async def test_another_family_on_the_port_is_named_as_foreign(tmp_path: Path) -> None:
    device = XbusDevice(tmp_path / "imu", options=XbusDeviceOptions(stuck=True))
    text = await refusal(device, make(tmp_path))
    assert "is not LPMS" in text
    assert "correct `port` or `driver`" in text


async def test_a_sleeping_sensor_is_silent_and_the_error_names_the_cause(tmp_path: Path) -> None:
    device = device_on(tmp_path, generation=1)
    device.asleep = True
    text = await refusal(device, make(tmp_path, generation=1), DeviceLostError)
    assert "silent" in text
    assert "put to sleep needs a power cycle" in text


async def test_stale_packets_before_the_acknowledgement_are_discarded(tmp_path: Path) -> None:
    device = device_on(
        tmp_path, configuration=LpmsConfiguration(GENERATION_3.quaternion, 100, True)
    )
    for number in range(20):
        device.push(number * 10_000_000, (1.0, 0.0, 0.0, 0.0))
    async with serving(device):
        run = DriverRun(make(tmp_path))
        while not (device.commands and device.commands[-1] == 0x07 and device.streaming):
            await asyncio.sleep(0.005)
        device.push(10_000_000_000, (0.0, 1.0, 0.0, 0.0))
        await run.wait_for(1)
        await run.cancel()
    assert [sample.ticks for sample in run.samples] == [5000]


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ({"generation": None}, "generation"),
        ({"generation": 2}, "generation"),
        ({"rate_hz": 400}, "generation 3 has 5, 10, 50, 100, 250, 500, 1000 Hz, not 400"),
        ({"generation": 1, "rate_hz": 250}, "generation 1 has 5, 10, 25"),
        ({"rate_hz": 1000}, "set `tick_hz`"),
        ({"direction": "both"}, "direction"),
    ],
)
def test_settings_that_cannot_work_are_refused(
    tmp_path: Path, table: dict[str, Any], text: str
) -> None:
    with pytest.raises(ValidationError, match=text):
        make(tmp_path, **table)


async def test_a_line_that_is_too_slow_is_refused(tmp_path: Path) -> None:
    device = device_on(tmp_path)
    text = await refusal(device, make(tmp_path, baud=9600))
    assert "100 Hz need 31000 bit/s" in text
