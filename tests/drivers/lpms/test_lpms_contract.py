"""Conformance tests of the driver of LPMS sensors on serial lines."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_drivers.lpms import LpmsImu, LpmsSettings
from jointfit_protocols.lpms.configuration import GENERATION_1, GENERATION_3, LpmsConfiguration
from jointfit_simulators.devices import LpmsDevice, LpmsDeviceOptions
from jointfit_simulators.driver_contract import DriverContract
from tests.drivers.driver_run import TextDevice

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

pytestmark = pytest.mark.real_time


def settings(folder: Path, **more: Any) -> LpmsSettings:
    table: dict[str, Any] = {"generation": 3, "baud": 115_200, "silence_s": 0.5} | more
    return LpmsSettings(id="S1", segment="thigh", driver="lpms", port=str(folder / "imu"), **table)


class TestLpmsOfGeneration3(DriverContract):
    registered_as = "lpms"

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> LpmsDevice:
        return LpmsDevice(folder / "imu", wire_noise=wire_noise)

    @override
    def make_driver(self, folder: Path) -> Driver:
        return LpmsImu(settings(folder))

    @override
    def make_wrong_device(self, folder: Path) -> TextDevice:
        return TextDevice(folder / "imu")


class TestLpmsOfGeneration1(TestLpmsOfGeneration3):
    """The old firmware sends 16-bit units of 1/1000 and acknowledges no command."""

    # Every connection waits for acknowledgements that this firmware does not send.
    starts_within_s = 15.0

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> LpmsDevice:
        options = LpmsDeviceOptions(
            generation=1,
            firmware="1.3.4",
            sends_seconds=True,
            unit=1_000,
            configuration=LpmsConfiguration(GENERATION_1.quaternion, 100, floats=False),
        )
        return LpmsDevice(folder / "imu", options=options, wire_noise=wire_noise)

    @override
    def make_driver(self, folder: Path) -> Driver:
        return LpmsImu(settings(folder, generation=1, precision="int16"))

    test_wrong_device_raises_device_misconfigured = None  # type: ignore[assignment]


class TestLpmsWithLongAddressAndOtherConvention(TestLpmsOfGeneration3):
    """The checksum adds 16-bit words, the world is ENU, and the sensor starts in command mode."""

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> LpmsDevice:
        options = LpmsDeviceOptions(
            sensor_id=258,
            words=True,
            world="ENU",
            world_to_sensor=False,
            streams_at_once=False,
            first_tick=2**32 - 20,
            configuration=LpmsConfiguration(GENERATION_3.quaternion, 100, floats=True),
        )
        return LpmsDevice(folder / "imu", options=options, wire_noise=wire_noise)

    @override
    def make_driver(self, folder: Path) -> Driver:
        convention = {"world": "ENU", "direction": "sensor_to_world"}
        return LpmsImu(settings(folder, sensor_id=258, **convention))

    test_wrong_device_raises_device_misconfigured = None  # type: ignore[assignment]
