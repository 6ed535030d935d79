"""A failed source recovers: with the right device on its port, or with free file descriptors."""

from __future__ import annotations

import asyncio
import contextlib
import resource
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.tools.child_processes import ChildProcess, daemon
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import XbusDevice
from jointfit_simulators.wires import PtyLine
from tests.system.station import BASE, Listener, listening, load_factor

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.broker_fixture import Broker

pytestmark = pytest.mark.system

NMEA = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
WRONG = "is not Xbus"
RETRY_S = 4.0
"""Limit from the return of a usable port to the availability of its device, s."""

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
    """Run a daemon with one sensor whose port does not exist yet."""
    rig = folder / "rig.toml"
    rig.write_text(RIG.format(folder=folder, port=port, base=BASE), encoding="utf-8")
    async with listening(port) as listener, daemon(folder, rig) as child:
        await listener.event("S1", "is not there")
        yield child, listener


@contextlib.asynccontextmanager
async def sensor(link: Path) -> AsyncIterator[None]:
    """Connect a moving IMU."""
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
    """Connect a GNSS receiver."""
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


@pytest.mark.timeout(180)
async def test_source_uses_the_right_device_after_a_wrong_one_on_its_port(
    tmp_path: Path, broker: Broker
) -> None:
    async with gateway(tmp_path, broker.port) as (child, listener):
        async with receiver(tmp_path / "S1"):
            await listener.event("S1", WRONG)
            await asyncio.sleep(1.5)  # the receiver stays: no further event is published
        assert len([event for event in listener.events if WRONG in event["text"]]) == 1
        async with sensor(tmp_path / "S1"):
            await listener.connected({"S1"}, RETRY_S * load_factor())
        child.check()
        log = (tmp_path / "daemon.log").read_text("utf-8")
        assert log.count("and when another device is on the port") == 1


@pytest.mark.timeout(180)
async def test_source_opens_its_port_again_once_a_file_descriptor_is_free(
    tmp_path: Path, broker: Broker
) -> None:
    async with gateway(tmp_path, broker.port) as (child, listener):
        assert child.process is not None
        _, most = resource.prlimit(child.process.pid, resource.RLIMIT_NOFILE)
        resource.prlimit(child.process.pid, resource.RLIMIT_NOFILE, (3, most))
        async with sensor(tmp_path / "S1"):
            await listener.event("S1", "no file descriptor left")
            resource.prlimit(child.process.pid, resource.RLIMIT_NOFILE, (most, most))
            await listener.connected({"S1"}, RETRY_S * load_factor())
        child.check()
        assert "Traceback" not in (tmp_path / "daemon.log").read_text("utf-8")
