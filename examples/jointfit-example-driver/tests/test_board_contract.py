"""Conformance suite of jointfitd, run for the driver of the board."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from jointfit_simulators.driver_contract import DriverContract
from jointfit_simulators.wires import PtyLine

from jointfit_board.imu import BoardImu, BoardSettings
from jointfit_board.simulator import BoardDevice

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_simulators.imu_device import WireNoise


class TextDevice:
    """Device of another type, which sends text."""

    def __init__(self, link: Path) -> None:
        self._line = PtyLine(link)
        self.unplug, self.plug = self._line.unplug, self._line.plug

    async def run(self) -> None:
        while True:
            self._line.write(b"the quick brown fox\r\n")
            await asyncio.sleep(0.05)


class TestBoard(DriverContract):
    registered_as = "board"

    def make_device(self, folder: Path, wire_noise: WireNoise) -> BoardDevice:
        return BoardDevice(folder / "imu", wire_noise=wire_noise)

    def make_driver(self, folder: Path) -> BoardImu:
        port = str(folder / "imu")
        return BoardImu(
            BoardSettings(id="S1", segment="thigh", driver="board", port=port, silence_s=0.4)
        )

    def make_wrong_device(self, folder: Path) -> TextDevice:
        return TextDevice(folder / "imu")


class TestBoardThatSendsAlready(TestBoard):
    def make_device(self, folder: Path, wire_noise: WireNoise) -> BoardDevice:
        return BoardDevice(folder / "imu", streaming=True, wire_noise=wire_noise)
