"""Conformance tests of the WitMotion driver."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_drivers.witmotion import WitMotionImu, WitMotionSettings
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import WitMotionDevice, WitMotionDeviceOptions
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.devices._witmotion_device import WITH_QUATERNION
from jointfit_simulators.driver_contract import DriverContract
from tests.drivers.driver_run import TextDevice

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

pytestmark = pytest.mark.real_time


def settings(folder: Path, **more: Any) -> WitMotionSettings:
    return WitMotionSettings(
        id="S1", segment="thigh", driver="witmotion", port=str(folder / "imu"), silence_s=0.5,
        **more,
    )  # fmt: skip


class TestWitMotion(DriverContract):
    """A device with factory settings sends at a low rate and without quaternions."""

    registered_as = "witmotion"

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> WitMotionDevice:
        return WitMotionDevice(folder / "imu", wire_noise=wire_noise)

    @override
    def make_driver(self, folder: Path) -> Driver:
        return WitMotionImu(settings(folder))

    @override
    def make_wrong_device(self, folder: Path) -> TextDevice:
        return TextDevice(folder / "imu")


class TestWitMotionWithDeviceTime(TestWitMotion):
    """A configured device answers no read commands, sends its time, and uses another world."""

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> WitMotionDevice:
        options = WitMotionDeviceOptions(
            content=WITH_QUATERNION | 1, rate_hz=100, answers_reads=False, world="NED",
            world_to_sensor=True,
        )  # fmt: skip
        return WitMotionDevice(folder / "imu", options=options, wire_noise=wire_noise)

    @override
    def make_driver(self, folder: Path) -> Driver:
        more = {"device_time": True, "world": "NED", "direction": "world_to_sensor"}
        return WitMotionImu(settings(folder, **more))


@pytest.mark.skipif(find_spec("vqf") is None, reason="the extra vqf is not installed")
class TestWitMotionRaw(TestWitMotion):
    """The device sends raw readings, and the gateway computes the orientation."""

    @override
    def make_driver(self, folder: Path) -> Driver:
        return WitMotionImu(settings(folder, orientation="gateway", settle_s=0.0))

    @override
    def matches(self, number: int, measurement: Any) -> bool:
        """Compare the acceleration, because the orientation depends on all earlier readings."""
        inertial = InertialSignals()
        inertial.update(0, orientation(number))
        force = inertial.value(Item.ACCELERATION)
        return bool(measurement.acceleration == pytest.approx(force, abs=0.02))
