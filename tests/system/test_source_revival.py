"""No source stops for good: another device on its port, or what was missing, brings it back."""

from __future__ import annotations

import asyncio
import contextlib
import resource
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.tools.child_processes import ChildProcess, daemon
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import XbusDevice
from jointfit_simulators.wires import PtyLine
from tests.system.station import BASE, Listener, listening

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.broker_fixture import Broker

pytestmark = pytest.mark.system

NMEA = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
WRONG = "is not Xbus"

RIG = """
[rig]
name = "revival"
[chain]
joints = ["hip", "knee"]
segments = ["thigh"]
[[imu]]
id = "S1"
segment = "thigh"
driver = "xbus"
port = "{folder}/S1"
[mqtt]
host = "127.0.0.1"
port = {port}
base = "{base}"
"""


@contextlib.asynccontextmanager
async def gateway(folder: Path, port: int) -> AsyncIterator[tuple[ChildProcess, Listener]]:
    """Run a daemon with one sensor that is not there yet."""
    rig = folder / "rig.toml"
    rig.write_text(RIG.format(folder=folder, port=port, base=BASE), encoding="utf-8")
    async with listening(port) as listener, daemon(folder, rig) as child:
        await listener.until(lambda: listener.said("S1", "is not there"), 20)
        yield child, listener


@contextlib.asynccontextmanager
async def sensor(link: Path) -> AsyncIterator[None]:
    """Plug in an IMU that moves."""
    device = XbusDevice(link)

    async def move() -> None:
        number = 0
        while True:
            number += 1
            device.push(number * 10_000_000, orientation(number))
            await asyncio.sleep(0.01)

    tasks = [asyncio.create_task(device.run()), asyncio.create_task(move())]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        device.unplug()


@contextlib.asynccontextmanager
async def receiver(link: Path) -> AsyncIterator[None]:
    """Plug in a GNSS receiver."""
    line = PtyLine(link)

    async def send() -> None:
        while True:
            line.write(NMEA)
            await asyncio.sleep(0.1)

    task = asyncio.create_task(send())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait([task])
        line.unplug()


def reports(listener: Listener, part: str) -> list[dict[str, Any]]:
    return [event for event in listener.events if part in event["text"]]


@pytest.mark.timeout(60)
async def test_the_right_device_on_the_port_of_a_wrong_one_is_used(
    tmp_path: Path, broker: Broker
) -> None:
    async with gateway(tmp_path, broker.port) as (child, listener):
        async with receiver(tmp_path / "S1"):
            await listener.until(lambda: listener.said("S1", WRONG), 20)
            await asyncio.sleep(1.5)  # it stays: nothing more is reported
        assert len(reports(listener, WRONG)) == 1
        async with sensor(tmp_path / "S1"):
            await listener.connected({"S1"}, 4)
        child.check()
        log = (tmp_path / "daemon.log").read_text("utf-8")
        assert log.count("retrying with another device on the port") == 1


@pytest.mark.timeout(60)
async def test_a_port_that_finds_no_descriptor_is_tried_again(
    tmp_path: Path, broker: Broker
) -> None:
    async with gateway(tmp_path, broker.port) as (child, listener):
        assert child.process is not None
        _, most = resource.prlimit(child.process.pid, resource.RLIMIT_NOFILE)
        resource.prlimit(child.process.pid, resource.RLIMIT_NOFILE, (3, most))
        async with sensor(tmp_path / "S1"):
            await listener.until(lambda: listener.said("S1", "no file descriptor left"), 5)
            resource.prlimit(child.process.pid, resource.RLIMIT_NOFILE, (most, most))
            await listener.connected({"S1"}, 4)
        child.check()
        assert "Traceback" not in (tmp_path / "daemon.log").read_text("utf-8")
