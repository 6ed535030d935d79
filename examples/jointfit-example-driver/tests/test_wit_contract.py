"""Conformance suite of jointfitd, run for the WitMotion driver."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from jointfit_simulators.driver_contract import DriverContract
from jointfit_simulators.wires import PtyLine

from jointfit_wit.imu import WitImu, WitSettings
from jointfit_wit.simulator import WitDevice

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_simulators.imu_device import WireNoise


class TextDevice:
    """Device that is no WitMotion IMU: it sends text."""

    def __init__(self, link: Path) -> None:
        self._line = PtyLine(link)
        self.unplug, self.plug = self._line.unplug, self._line.plug

    async def run(self) -> None:
        while True:
            self._line.write(b"the quick brown fox\r\n")
            await asyncio.sleep(0.05)


class TestWit(DriverContract):
    registered_as = "wit"

    def make_device(self, folder: Path, wire_noise: WireNoise) -> WitDevice:
        return WitDevice(folder / "imu", wire_noise=wire_noise)

    def make_driver(self, folder: Path) -> WitImu:
        port = str(folder / "imu")
        return WitImu(WitSettings(id="S1", segment="thigh", driver="wit", port=port, silence_s=0.4))

    def make_wrong_device(self, folder: Path) -> TextDevice:
        return TextDevice(folder / "imu")


class TestWitWithoutQuaternionOutput(TestWit):
    def make_device(self, folder: Path, wire_noise: WireNoise) -> WitDevice:
        return WitDevice(folder / "imu", quaternions=False, wire_noise=wire_noise)

    def test_driver_does_not_write_flash(self, tmp_path: Path) -> None:
        device = self.make_device(tmp_path, lambda data: data)

        async def scene() -> None:
            async with self.streaming(device, self.make_driver(tmp_path)):
                pass

        asyncio.run(scene())
        assert device.saved == 0
