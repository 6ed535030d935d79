"""The monitor in a pseudo-terminal, with the daemon, a broker and simulated hardware."""

from __future__ import annotations

import os
import signal
import sys
from typing import TYPE_CHECKING

import pytest

from tests.broker_fixture import HOST
from tests.system.station import FIT_PATIENCE_S, Station
from tests.tools.monitor.terminal import terminal_program

if TYPE_CHECKING:
    from pathlib import Path

    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(400)]

OPTIONS = ("--follow", "--no-mocap", "--rate", "50", "--output-rate-hz", "50")
"""Options of the simulator: IMUs only, because a fit with cameras takes long."""
SHORT = (("static_s = 5", "static_s = 3"),)
ENVIRONMENT = {**os.environ, "TERM": "xterm-256color", "LANG": "C.UTF-8", "LC_ALL": "C.UTF-8"}


def command(broker: Broker, *options: str) -> list[str]:
    return [
        sys.executable, "-m", "jointfit_daemon.tools.__main__", "monitor",
        "--broker", f"mqtt://{HOST}:{broker.port}", *options,
    ]  # fmt: skip


async def test_a_rig_is_calibrated_over_a_terminal_and_the_monitor_survives_daemon_and_broker(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port, OPTIONS)
    async with (
        station.simulator(*SHORT),
        terminal_program(command(broker), (80, 24), ENVIRONMENT) as monitor,
    ):
        await monitor.shows("Waiting for jointfitd on 127.0.0.1")
        async with station.daemon() as daemon:
            await monitor.shows("Not calibrated yet")  # the only rig was found
            await monitor.until(lambda text: text.count("✔ Works") == 4)
            monitor.press("s")
            await monitor.shows("Static phase runs")
            await monitor.shows("✔ Calibrated, version 1", "Knee flexion", within_s=FIT_PATIENCE_S)
            monitor.press("3")
            await monitor.shows("✔ in force")
            monitor.press("r")
            await monitor.shows("jointfitd refuses use-calibration")
            monitor.press("5m")
            await monitor.shows("Text of the mark")
            monitor.press("squats begin\r")
            await monitor.shows("✔ mark 1: done", "squats begin")
            monitor.press("1")
            assert daemon.process is not None
            daemon.process.send_signal(signal.SIGKILL)
            await monitor.shows("✖ jointfitd is not running", "systemctl status jointfitd")
        async with station.daemon():
            await monitor.shows("✔ Calibrated, version 1", "Knee flexion")
            broker.stop()
            await monitor.shows("✖ Broker lost", "start the broker")
            broker.start()
            await monitor.shows("✔ Calibrated, version 1")
        monitor.press("q")
        assert await monitor.process.wait() == 0


async def test_a_stop_signal_restores_the_terminal_and_ends_with_its_code(broker: Broker) -> None:
    async with terminal_program(command(broker), (40, 20), ENVIRONMENT) as monitor:
        await monitor.shows("Waiting for jointfitd")
        monitor.process.terminate()
        assert await monitor.process.wait() == 128 + signal.SIGTERM
        assert "Traceback" not in monitor.screen.text
