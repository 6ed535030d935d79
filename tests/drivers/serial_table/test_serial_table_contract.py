"""Conformance tests of the serial-table driver, one class per kind of table."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, ClassVar

import pytest
from typing_extensions import override

from jointfit_drivers.serial_table import SerialTableImu
from jointfit_simulators.driver_contract import DriverContract
from jointfit_simulators.wires import PtyLine
from tests.drivers.self_described import (
    CSV,
    FLOATS,
    INTEGERS,
    LINES,
    serial_device,
    serial_settings,
)

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.devices import TableDevice
    from jointfit_simulators.imu_device import WireNoise

pytestmark = pytest.mark.real_time


class ChattyDevice:
    """A device of another kind that sends text without a request."""

    def __init__(self, link: Path) -> None:
        self._line = PtyLine(link)
        self.unplug, self.plug = self._line.unplug, self._line.plug

    async def run(self) -> None:
        serving = asyncio.create_task(self._line.serve(lambda _: None))
        try:
            while True:
                self._line.write(b"T=21.5 C, p=1013 hPa\r\n")
                await asyncio.sleep(0.01)
        finally:
            serving.cancel()


class TestIntegersInFixedFrames(DriverContract):
    registered_as = "serial-table"
    table: ClassVar[dict[str, Any]] = INTEGERS
    faults: ClassVar[dict[str, Any]] = {}

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> TableDevice:
        settings = serial_settings(folder / "imu", self.table)
        return serial_device(settings, wire_noise, **self.faults)

    @override
    def make_driver(self, folder: Path) -> Driver:
        return SerialTableImu(serial_settings(folder / "imu", self.table))

    @override
    def make_wrong_device(self, folder: Path) -> Any:
        return ChattyDevice(folder / "imu")


class TestFloatsInFramesWithALengthAmongOtherMessages(TestIntegersInFixedFrames):
    table = FLOATS
    faults: ClassVar[dict[str, Any]] = {"other": bytes.fromhex("b562 0005 01 02030405 e719")}


class TestLinesWithPrefixAndChecksum(TestIntegersInFixedFrames):
    table = LINES
    faults: ClassVar[dict[str, Any]] = {"greeting": b"\r\nMPU6050 ready\r\n"}


class TestLinesOfAnArduino(TestIntegersInFixedFrames):
    table = CSV
    faults: ClassVar[dict[str, Any]] = {}

    # The lines have no checksum, so a changed digit is not detected.
    test_line_noise_affects_only_damaged_samples = None  # type: ignore[assignment]
