"""Conformance tests of the x-IMU3 driver."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar

import pytest
from typing_extensions import override

from jointfit_drivers.ximu3 import XImu3Imu, XImu3Settings
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import XImu3Device, XImu3DeviceOptions
from jointfit_simulators.devices._inertial_signals import GRAVITY
from jointfit_simulators.driver_contract import DriverContract
from tests.drivers.driver_run import TextDevice

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

pytestmark = pytest.mark.real_time

AT_100_HZ = {"serial_mode": 1, "ahrs_message_rate_divisor": 4}


class TestXImu3(DriverContract):
    registered_as = "ximu3"
    device_settings: ClassVar[dict[str, object]] = {}
    keys: ClassVar[dict[str, Any]] = {}

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> XImu3Device:
        options = XImu3DeviceOptions(AT_100_HZ | self.device_settings)
        return XImu3Device(folder / "imu", options=options, wire_noise=wire_noise)

    @override
    def make_driver(self, folder: Path) -> Driver:
        table = {"id": "S1", "segment": "thigh", "driver": "ximu3", "silence_s": 0.5}
        table |= {"port": str(folder / "imu")} | self.keys
        return XImu3Imu(XImu3Settings.model_validate(table))

    @override
    def make_wrong_device(self, folder: Path) -> TextDevice | None:
        # The search at all speeds takes seconds and is the same for every output.
        return TextDevice(folder / "imu") if type(self) is TestXImu3 else None


class TestXImu3WithMatricesInNed(TestXImu3):
    device_settings: ClassVar[dict[str, object]] = {
        "ahrs_message_type": 1, "ahrs_axes_convention": 2,
    }  # fmt: skip


class TestXImu3WithEulerAnglesInAscii(TestXImu3):
    device_settings: ClassVar[dict[str, object]] = {
        "ahrs_message_type": 2, "ahrs_axes_convention": 1, "binary_mode_enabled": False,
    }  # fmt: skip


class TestXImu3ThatIsListenedTo(TestXImu3):
    """A board that only sends."""

    keys: ClassVar[dict[str, Any]] = {"passive": True}

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> XImu3Device:
        options = XImu3DeviceOptions(AT_100_HZ, answers=False)
        return XImu3Device(folder / "imu", options=options, wire_noise=wire_noise)


@pytest.mark.skipif(find_spec("vqf") is None, reason="the extra vqf is not installed")
class TestXImu3WithOrientationOnTheGateway(TestXImu3):
    """The messages have no checksum and raw values no fixed norm, so noise is not detected."""

    has_history = True
    has_noise = False
    device_settings: ClassVar[dict[str, object]] = {
        "ahrs_message_rate_divisor": 0, "inertial_message_rate_divisor": 4,
    }  # fmt: skip
    keys: ClassVar[dict[str, Any]] = {"orientation": "gateway"}

    @override
    def matches(self, number: int, measurement: Any) -> bool:
        """Compare the acceleration, because the orientation depends on all earlier samples."""
        x, y, z = vertical(number)
        force = tuple(GRAVITY * part for part in (x, y, z))
        return bool(measurement.acceleration == pytest.approx(force, abs=0.01))


def vertical(number: int) -> tuple[float, float, float]:
    """Return the vertical in sensor axes: the third row of the rotation matrix."""
    w, x, y, z = orientation(number)
    return 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
