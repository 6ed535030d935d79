"""Conformance tests of the MIP driver."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_drivers.mip import MipImu
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import MipDevice, MipDeviceOptions
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.driver_contract import DriverContract
from tests.drivers.driver_run import TextDevice
from tests.drivers.mip.mip_packets import settings

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise


pytestmark = pytest.mark.real_time
LEGACY_RATES = ((0x80, 1000), (0x82, 500))


class TestMip(DriverContract):
    registered_as = "mip"

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> MipDevice:
        return MipDevice(folder / "imu", wire_noise=wire_noise)

    @override
    def make_driver(self, folder: Path) -> Driver:
        return MipImu(settings(folder))

    @override
    def make_wrong_device(self, folder: Path) -> TextDevice:
        return TextDevice(folder / "imu")


class TestMipLegacyThatStreamsBothSetsFromTheStart(TestMip):
    """The device first sends old samples. It sends two data sets; the driver uses one."""

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> MipDevice:
        options = MipDeviceOptions(
            family="legacy",
            base_rates_hz=LEGACY_RATES,
            formats=((0x80, ((0x0A, 10), (0x12, 10))), (0x82, ((0x11, 5), (0x03, 5)))),
            streams=(0x80, 0x82),
            idle_delay_s=0.05,
            filter_delay=0,
        )
        return MipDevice(folder / "imu", options=options, wire_noise=wire_noise)


@pytest.mark.skipif(find_spec("vqf") is None, reason="the extra vqf is not installed")
class TestMipWithRawMeasurements(TestMip):
    """The device sends raw measurements, and the gateway computes the orientation."""

    has_history = True

    @override
    def make_driver(self, folder: Path) -> Driver:
        return MipImu(settings(folder, orientation="gateway"))

    @override
    def matches(self, number: int, measurement: Any) -> bool:
        """Compare the specific force, because the orientation depends on all earlier readings."""
        signals = InertialSignals()
        signals.update(0, orientation(number))
        return bool(measurement.acceleration == pytest.approx(signals.force, abs=0.01))
