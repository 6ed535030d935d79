"""An independent package reads the registers of the virtual device."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_protocols.orientation import native_of
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import VectorNavDevice
from tests.drivers.driver_run import serving

if TYPE_CHECKING:
    from pathlib import Path

vectornav: Any = pytest.importorskip("vectornav")
pytestmark = pytest.mark.real_time


async def test_an_independent_package_reads_the_registers(tmp_path: Path) -> None:
    device = VectorNavDevice(tmp_path / "imu")

    def read() -> tuple[str, int, str, dict[str, float]]:
        with vectornav.VN200(str(tmp_path / "imu")) as sensor:
            return (
                sensor.read_model_number(),
                sensor.read_serial_number(),
                sensor.read_firmware_version(),
                sensor.read_quaternion(),
            )

    async with serving(device):
        device.push(10_000_000, orientation(7))
        model, serial, firmware, q = await asyncio.to_thread(read)
    assert (model, serial, firmware) == ("VN-100S-CR", 100_012_345, "3.1.0.0")
    w, x, y, z = native_of(orientation(7), "NED")
    assert (q["q0"], q["q1"], q["q2"], q["q3"]) == pytest.approx((x, y, z, w), abs=1e-6)
