"""Simulated sensors of a scene are read by the driver with the keys that the scene writes."""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.driver import find_driver
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.scene._imu_families import IMU_FAMILIES, CanFamily, SensorPlace, UartFamily
from jointfit_simulators.settings import Knobs
from jointfit_simulators.wires import SlcanAdapter
from tests.drivers.driver_run import DriverRun, serving

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.real_time


@pytest.mark.parametrize(
    ("name", "number", "rate_hz"),
    [
        ("lpms", 1, 100.0), ("lpms", 2, 200.0), ("lpms-can", 1, 100.0), ("lpms-can", 2, 100.0),
        ("xbus-mtdata", 1, 100.0),
    ],
)  # fmt: skip
async def test_a_sensor_of_a_scene_is_read_as_its_table_says(
    tmp_path: Path, name: str, number: int, rate_hz: float
) -> None:
    place = SensorPlace(Knobs(rate_hz=rate_hz), f"S{number}", number, sensors=2, sync_line=False)
    family = IMU_FAMILIES[name]
    if isinstance(family, UartFamily):
        connected = family.create(place, tmp_path / "imu")
    else:
        assert isinstance(family, CanFamily)
        connected = family.create(place, SlcanAdapter(tmp_path / "adapter"))

    table: dict[str, Any] = tomllib.loads("\n".join(connected.keys))
    if "can" in table:
        table["can"] = {"interface": "slcan", "channel": str(tmp_path / "adapter")}
    name = family.driver or name
    table |= {"id": "S1", "segment": "thigh", "driver": name, "rate_hz": rate_hz}
    driver = find_driver(name)
    async with serving(connected.device, feeding=True):
        run = DriverRun(driver(driver.Settings.model_validate(table)))
        await run.wait_for(20)
        await run.cancel()

    sent = [orientation(k) for k in range(1000)]  # a sensor counts from its handshake on
    for sample in run.samples:
        products = [abs(sum(map(lambda a, b: a * b, sample.q_world_sensor, q))) for q in sent]
        assert max(products) > 1 - 1e-6
    assert connected.device.sent >= len(run.samples)
