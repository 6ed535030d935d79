"""A long run with calibration, reconnection, reload and online learning, replayed exactly.

The run takes four minutes. With the environment variable ``JOINTFIT_RUN_S=600``, it takes ten.
"""

from __future__ import annotations

import asyncio
import os
import time
from typing import TYPE_CHECKING

import pytest
from typing_extensions import override  # typing has it from Python 3.12

from jointfit_daemon.reprocessing import verify_recording
from tests.system.station import Station, running, stopped
from tests.system.test_calibrated_run import calibrate, reconnect, reload

if TYPE_CHECKING:
    from pathlib import Path

    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(1500)]

RUN_S = float(os.environ.get("JOINTFIT_RUN_S", "250"))
"""Duration of the run, s. Online learning refits the models after three minutes."""
MOTION_S = 10.0
"""Duration of each motion, s."""


class LearningStation(Station):
    """A station whose daemon learns online."""

    @override
    def write_rig(self, *changes: tuple[str, str]) -> None:
        learning = ("[calibration]\n", "[calibration]\nlearn_online = true\n")
        super().write_rig(learning, *changes)


async def test_a_long_run_is_replayed_byte_for_byte(tmp_path: Path, broker: Broker) -> None:
    began = time.monotonic()
    station = LearningStation(tmp_path, broker.port, more_toml="[recording]\n")
    async with running(station) as (simulator, daemon, listener):
        await calibrate(simulator, listener)
        await listener.until(lambda: listener.latest["calibration"]["version"])
        await reconnect(simulator, listener, "S1")
        await reload(station, daemon, listener)
        number = 0
        while time.monotonic() - began < RUN_S:
            await simulator.send_command(f"play {('walk', 'squat', 'sit_to_stand')[number % 3]}")
            await asyncio.sleep(MOTION_S)
            number += 1
        code, _ = await stopped(daemon)
        assert code == 0, station.log

    found = await asyncio.to_thread(verify_recording, tmp_path / "state" / "recordings")
    assert found.passed, found.lines()
    assert found.gaps == ()
    assert found.compared["output/state"] > 0.8 * 80.0 * RUN_S
    assert found.seconds > 0.9 * RUN_S
