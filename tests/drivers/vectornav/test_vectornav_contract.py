"""Conformance tests of the VectorNav driver."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_drivers.vectornav import VectorNavImu
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import VectorNavDevice, VectorNavDeviceOptions
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.driver_contract import DriverContract
from tests.drivers.driver_run import TextDevice
from tests.drivers.vectornav.vectornav_messages import settings

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise


pytestmark = pytest.mark.real_time


class TestVectorNav(DriverContract):
    """The device has factory settings: it sends ASCII output and no binary output."""

    registered_as = "vectornav"

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> VectorNavDevice:
        return VectorNavDevice(folder / "imu", wire_noise=wire_noise)

    @override
    def make_driver(self, folder: Path) -> Driver:
        return VectorNavImu(settings(folder))

    @override
    def make_wrong_device(self, folder: Path) -> TextDevice:
        return TextDevice(folder / "imu")


class TestVectorNavThatStreamsFromTheStart(TestVectorNav):
    """Old messages come first, and the output has further fields."""

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> VectorNavDevice:
        options = VectorNavDeviceOptions(
            model="VN-300", imu_rate_hz=400, outputs=((3, 4, (0x00, 0x03, 0x04, 0x05, 0x208)),)
        )
        return VectorNavDevice(folder / "imu", options=options, wire_noise=wire_noise)


@pytest.mark.skipif(find_spec("vqf") is None, reason="the extra vqf is not installed")
class TestVectorNavWithRawMeasurements(TestVectorNav):
    """The device sends raw measurements, and the gateway computes the orientation."""

    has_history = True

    @override
    def make_driver(self, folder: Path) -> Driver:
        return VectorNavImu(settings(folder, orientation="gateway", magnetometer=True))

    @override
    def matches(self, number: int, measurement: Any) -> bool:
        """Compare the specific force, because the orientation depends on all earlier readings."""
        signals = InertialSignals()
        signals.update(0, orientation(number))
        return bool(measurement.acceleration == pytest.approx(signals.force, abs=0.01))
