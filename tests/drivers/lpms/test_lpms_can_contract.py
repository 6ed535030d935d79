"""Conformance tests of the driver of LPMS sensors on CAN, over SLCAN and in process."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_daemon.driver import CanBusSettings
from jointfit_drivers.lpms import LpmsCanIdSettings, LpmsCanImu, LpmsCanSettings
from jointfit_protocols.lpms.channels import sequential_ids, tpdo_ids
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import LpmsCanDevice, LpmsCanDeviceOptions
from jointfit_simulators.driver_contract import DriverContract
from jointfit_simulators.wires import PythonCanWire, SlcanAdapter
from tests.drivers.driver_run import TextDevice

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

pytestmark = pytest.mark.real_time


def settings(
    interface: str, channel: str, numbers: tuple[int, ...], mode: str, precision: str, **more: Any
) -> LpmsCanSettings:
    ids = LpmsCanIdSettings(**{f"frame{k}": number for k, number in enumerate(numbers, 1)})
    table = {"id": "S3", "segment": "shank", "driver": "lpms-can", "silence_s": 0.4, "ids": ids}
    bus = CanBusSettings(interface=interface, channel=channel)
    return LpmsCanSettings.model_validate(
        {**table, "can": bus, "mode": mode, "precision": precision, **more}
    )


class TestLpmsInCanopenStyle(DriverContract):
    """The sensor sends 16-bit integers in all four frames, and a heartbeat."""

    registered_as = "lpms-can"
    numbers = tpdo_ids(1)
    mode, precision = "canopen", "int16"

    @property
    def options(self) -> LpmsCanDeviceOptions:
        return LpmsCanDeviceOptions()

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> LpmsCanDevice:
        adapter = SlcanAdapter(folder / "adapter", wire_noise=wire_noise)
        return LpmsCanDevice(adapter, self.options)

    @override
    def make_driver(self, folder: Path) -> Driver:
        path = str(folder / "adapter")
        # A test sends a sample every 2 ms. The driver joins the frames of a sample only if they
        # arrive within half a sample period.
        more = {"rate_hz": 500}
        return LpmsCanImu(settings("slcan", path, self.numbers, self.mode, self.precision, **more))

    @override
    def make_wrong_device(self, folder: Path) -> TextDevice:
        return TextDevice(folder / "adapter")


class TestLpmsInSequentialMode(TestLpmsInCanopenStyle):
    """The sensor sends 32-bit floats with consecutive identifiers, and no unused frames."""

    numbers = sequential_ids(1, spaced=False)
    mode, precision = "sequential", "float32"

    @property
    @override
    def options(self) -> LpmsCanDeviceOptions:
        return LpmsCanDeviceOptions(
            mode="sequential", ids=sequential_ids(1, spaced=False), precision="float32",
            sends_idle_frames=False,
        )  # fmt: skip

    test_wrong_device_raises_device_misconfigured = None  # type: ignore[assignment]

    @override
    def matches(self, number: int, measurement: Any) -> bool:
        """Return whether `measurement` has the orientation of sample `number`, within 0.09 rad.

        The line of an adapter has no checksum. A wrong digit of a small component changes the norm
        by less than 1 %, so the sample is accepted. It changes the orientation by less than
        0.09 rad.
        """
        products = zip(orientation(number), measurement.q_world_sensor, strict=True)
        return bool(abs(sum(a * b for a, b in products)) > 1 - 1e-3)


class TestLpmsOfOldFirmwareOnABusWithoutDescriptor(DriverContract):
    """The sensor sends units of 1/1000 with the identifiers of old firmware, in process."""

    registered_as = "lpms-can"
    has_noise = False
    ids = sequential_ids(2, spaced=True)

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> LpmsCanDevice:
        options = LpmsCanDeviceOptions(
            mode="sequential", ids=self.ids, unit=1_000, mapping=(8, 5, 6, 7)
        )
        return LpmsCanDevice(PythonCanWire("virtual", str(folder)), options)

    @override
    def make_driver(self, folder: Path) -> Driver:
        more = {"mapping": (8, 5, 6, 7)}
        return LpmsCanImu(settings("virtual", str(folder), self.ids, "sequential", "int16", **more))

    test_line_noise_affects_only_damaged_samples = None  # type: ignore[assignment]
    test_wrong_device_raises_device_misconfigured = None  # type: ignore[assignment]
