"""Conformance tests of the Xbus driver."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_drivers.xbus import XbusImu, XbusSettings
from jointfit_protocols.xbus.configuration import MAX_RATE
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import XbusDevice, XbusDeviceOptions
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.driver_contract import DriverContract
from tests.drivers.driver_run import TextDevice

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise


pytestmark = pytest.mark.real_time


def settings(folder: Path, **more: Any) -> XbusSettings:
    return XbusSettings(
        id="S1", segment="thigh", driver="xbus", port=str(folder / "imu"), baud=115_200,
        silence_s=0.5, **more,
    )  # fmt: skip


class TestXbus(DriverContract):
    registered_as = "xbus"

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> XbusDevice:
        return XbusDevice(folder / "imu", wire_noise=wire_noise)

    @override
    def make_driver(self, folder: Path) -> Driver:
        return XbusImu(settings(folder))

    @override
    def make_wrong_device(self, folder: Path) -> TextDevice:
        return TextDevice(folder / "imu")


class TestXbusThatStreamsFromTheStart(TestXbus):
    """The device first sends the rest of a message and old samples, like a real device."""

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> XbusDevice:
        options = XbusDeviceOptions(measures_at_once=True, config_delay_s=0.05, gnss=True)
        return XbusDevice(folder / "imu", options=options, wire_noise=wire_noise)


RAW_OUTPUTS = (
    (Item.PACKET_COUNTER, MAX_RATE),
    (Item.SAMPLE_TIME_FINE, MAX_RATE),
    (Item.STATUS_WORD, MAX_RATE),
    (Item.RATE_OF_TURN, 100),
    (Item.ACCELERATION, 100),
)


@pytest.mark.skipif(find_spec("vqf") is None, reason="the extra vqf is not installed")
class TestXbusWithRawMeasurements(TestXbus):
    """The device sends raw readings, and the gateway computes the orientation."""

    has_history = True

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> XbusDevice:
        options = XbusDeviceOptions(outputs=RAW_OUTPUTS)
        return XbusDevice(folder / "imu", options=options, wire_noise=wire_noise)

    @override
    def make_driver(self, folder: Path) -> Driver:
        return XbusImu(settings(folder, orientation="gateway"))

    @override
    def matches(self, number: int, measurement: Any) -> bool:
        """Compare the acceleration, because the orientation depends on all earlier readings."""
        felt = InertialSignals()
        felt.update(0, orientation(number))
        force = felt.value(Item.ACCELERATION)
        return bool(measurement.acceleration == pytest.approx(force, abs=0.01))
