"""Conformance tests of the can-table driver, over SLCAN and on an in-process bus."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import pytest
from typing_extensions import override

from jointfit_drivers.can_table import CanTableImu
from jointfit_simulators.driver_contract import DriverContract
from jointfit_simulators.wires import PythonCanWire, SlcanAdapter
from tests.drivers.driver_run import TextDevice
from tests.drivers.self_described import HALVES, ONE_FRAME, PAGES, SBG, can_device, can_settings

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.devices import TableDevice
    from jointfit_simulators.imu_device import WireNoise

pytestmark = pytest.mark.real_time


class TestTimeAndQuaternionOverSlcan(DriverContract):
    registered_as = "can-table"
    table: ClassVar[dict[str, Any]] = SBG

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> TableDevice:
        settings = can_settings("slcan", str(folder / "adapter"), self.table)
        return can_device(settings, SlcanAdapter(folder / "adapter", wire_noise=wire_noise))

    @override
    def make_driver(self, folder: Path) -> Driver:
        return CanTableImu(can_settings("slcan", str(folder / "adapter"), self.table))

    @override
    def make_wrong_device(self, folder: Path) -> TextDevice:
        return TextDevice(folder / "adapter")


class TestHalvesOfFloatsWith29BitIds(TestTimeAndQuaternionOverSlcan):
    table = HALVES

    # A flipped bit can change a digit on the adapter's line to another digit. A change of a float32
    # mantissa can be too small to be detected by the norm.
    test_line_noise_affects_only_damaged_samples = None  # type: ignore[assignment]


class TestFramesWithTheSameId(TestTimeAndQuaternionOverSlcan):
    table = PAGES


class TestOneFrameOnABusWithoutDescriptor(DriverContract):
    registered_as = "can-table"

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> TableDevice:
        settings = can_settings("virtual", str(folder), ONE_FRAME)
        return can_device(settings, PythonCanWire("virtual", str(folder)))

    @override
    def make_driver(self, folder: Path) -> Driver:
        return CanTableImu(can_settings("virtual", str(folder), ONE_FRAME))

    # An in-process bus has no noise, and devices of any kind may use it.
    test_line_noise_affects_only_damaged_samples = None  # type: ignore[assignment]
    test_wrong_device_raises_device_misconfigured = None  # type: ignore[assignment]
