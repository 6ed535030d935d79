"""From `jointfit init` to joint angles on the dashboard, with simulated hardware."""

from __future__ import annotations

import asyncio
import os
import re
import sys
import time
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.tools.child_processes import daemon, simulator
from tests.broker_fixture import HOST
from tests.system.station import FIT_PATIENCE_S
from tests.tools.dashboard.browser import chromium, opened

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(400)]

LIMIT_S = 180.0
"""Longest time from the first question to angles, s: the goal of a first start."""
RATE_HZ = 50


class Steps:
    """Durations of the steps of a first start."""

    def __init__(self) -> None:
        self.times: list[tuple[str, float]] = [("start", time.monotonic())]

    def done(self, step: str) -> None:
        """End a step, and print its duration."""
        now = time.monotonic()
        print(f"{step:40} {now - self.times[-1][1]:6.1f} s")
        self.times.append((step, now))

    @property
    def total_s(self) -> float:
        """Time since the start, s."""
        return self.times[-1][1] - self.times[0][1]


def lines(hardware: Path, server_port: int, broker_port: int) -> Iterator[tuple[str, str]]:
    """Yield a pattern of each question that has no suitable proposal, and the answer."""
    yield r"Name of the rig", "first start"
    yield r"Poses per second", str(RATE_HZ)
    yield r"CAN adapters", str(hardware / "ttyCAN0")
    yield r"Connection of the sensor \w+-front", "find"
    yield r"Connection of the sensor \w+-side", str(hardware / "ttyCAN0")
    yield r"identifiers of the sensor thigh", "0x205 0x206 0x221"
    yield r"identifiers of the sensor shank", "0x405 0x406 0x421"
    yield r"optical motion-capture", "no"
    yield r"Computer of", f"{HOST}:{server_port}"
    yield r"MQTT broker", f"{HOST}:{broker_port}"


async def test_init_leads_to_angles_on_the_dashboard_within_three_minutes(
    tmp_path: Path, broker: Broker
) -> None:
    hardware = tmp_path / "hardware"
    hardware.mkdir()
    options = ("--follow", "--no-mocap", "--rate", str(RATE_HZ))
    async with simulator(hardware, broker.port, "jointfit/first start", options) as device:
        await device.ready()
        steps = Steps()
        answers = list(lines(hardware, 1510, broker.port))
        init = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "jointfit_daemon.tools.__main__", "init", str(tmp_path / "lab"),
            "--port", str(hardware / "ttyS1"), "--port", str(hardware / "ttyS3"),
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )  # fmt: skip
        assert init.stdin is not None
        assert init.stdout is not None
        shown = []
        while line := (await init.stdout.readline()).decode():
            shown.append(line)
            if re.match(r"\(\d+/\d+\) ", line):
                matching = [text for pattern, text in answers if re.search(pattern, line)]
                init.stdin.write(f"{(matching or [''])[0]}\n".encode())
            if turn := re.search(r"Turn the sensor (\w+)-front", line):
                sensor = {"thigh": "S1", "shank": "S3"}[turn[1]]
                await device.send_command(f"slip {sensor} 80")
        assert await init.wait() == 0, "".join(shown)
        steps.done("jointfit init, two sensors by movement")

        rig = tmp_path / "lab" / "rig.toml"
        text = rig.read_text()
        assert f'port = "{hardware / "ttyS1"}"\nbaud' in text.partition("shank-front")[0]
        async with daemon(tmp_path, rig), chromium() as browser:
            server = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "jointfit_daemon.tools.__main__", "dashboard",
                "--listen", f"{HOST}:0", "--broker", f"mqtt://{HOST}:{broker.port}",
                stdout=asyncio.subprocess.PIPE,
            )  # fmt: skip
            try:
                assert server.stdout is not None
                url = (await server.stdout.readline()).decode().split()[1]
                async with opened(browser, url) as page:
                    await page.until_text("#empty", "Not calibrated yet", 60)
                    steps.done("daemon and dashboard")
                    await page.page.wait_for_function(
                        "() => [...jointfit.store.devices.values()]"
                        ".filter((each) => each.availability === 'online').length === 4",
                        timeout=60_000,
                    )
                    steps.done("all sensors online")
                    await page.page.click("#main-action")
                    await page.page.click("text=Start standing")
                    await page.until_text("#rig-state", "Calibrated, version 1", FIT_PATIENCE_S)
                    steps.done("static pose")
                    await page.show("live")
                    await page.until_text("#angle-value", "°")
                    steps.done("angle on the dashboard")
                    await page.picture("first-start")
                    assert page.errors == []
            finally:
                server.terminate()
                await server.communicate()
    print(f"{'total':40} {steps.total_s:6.1f} s")
    assert steps.total_s <= LIMIT_S
