"""Conformance tests of the BNO085 driver, in the modes UART-RVC and UART-SHTP."""

from __future__ import annotations

import asyncio
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar

import pytest
from typing_extensions import override

from jointfit_drivers.bno085 import Bno085Imu, Bno085Settings
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import Bno085Device, Bno085DeviceOptions
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.driver_contract import DriverContract
from jointfit_simulators.wires import PtyLine
from tests.drivers.driver_run import TextDevice

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

pytestmark = pytest.mark.real_time


def settings(folder: Path, baud: int, **more: Any) -> Bno085Settings:
    return Bno085Settings(
        id="S1", segment="thigh", driver="bno085", port=str(folder / "imu"), baud=baud,
        silence_s=0.5, **more,
    )  # fmt: skip


class TalkingDevice:
    """Device of another kind that sends text without being asked."""

    def __init__(self, link: Path) -> None:
        self._line = PtyLine(link)
        self.unplug, self.plug = self._line.unplug, self._line.plug

    async def run(self) -> None:
        while True:
            self._line.write(b"the quick brown fox\r\n")
            await asyncio.sleep(0.02)


class TestBno085Rvc(DriverContract):
    registered_as = "bno085"

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> Bno085Device:
        options = Bno085DeviceOptions(mode="rvc")
        return Bno085Device(folder / "imu", options=options, wire_noise=wire_noise)

    @override
    def make_driver(self, folder: Path) -> Driver:
        return Bno085Imu(settings(folder, 115_200))

    @override
    def make_wrong_device(self, folder: Path) -> Any:
        return TalkingDevice(folder / "imu")


class TestBno085Shtp(TestBno085Rvc):
    """The line has no checksum, so a damaged quaternion of norm 1 is not detected."""

    has_noise: ClassVar[bool] = False
    baud: ClassVar[int | None] = 3_000_000

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> Bno085Device:
        return Bno085Device(folder / "imu", wire_noise=wire_noise)

    @override
    def make_driver(self, folder: Path) -> Driver:
        return Bno085Imu(settings(folder, 3_000_000, report="arvr_game_rotation_vector"))

    @override
    def make_wrong_device(self, folder: Path) -> Any:
        return TextDevice(folder / "imu")


@pytest.mark.skipif(find_spec("vqf") is None, reason="the extra vqf is not installed")
class TestBno085Raw(TestBno085Shtp):
    """The device sends raw readings, and the gateway computes the orientation."""

    @override
    def make_driver(self, folder: Path) -> Driver:
        more = {"orientation": "gateway", "magnetometer": True, "settle_s": 0.0}
        return Bno085Imu(settings(folder, 3_000_000, **more))

    @override
    def matches(self, number: int, measurement: Any) -> bool:
        """Compare the acceleration, because the orientation depends on all earlier readings."""
        inertial = InertialSignals()
        inertial.update(0, orientation(number))
        force = inertial.value(Item.ACCELERATION)
        return bool(measurement.acceleration == pytest.approx(force, abs=0.02))
