"""Hostile UDP datagrams have no effect, or do not stop the frames if the sender is forged."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import socket
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.tools.child_processes import daemon
from jointfit_protocols.natnet import (
    CommandResponse,
    EchoResponse,
    MarkerSetDescription,
    ModelDefinition,
    NatNetMessageId,
    ServerInfo,
    encode,
)
from jointfit_simulators.devices import (
    NatNetServer,
    NatNetServerOptions,
    RigidBodyAsset,
    XbusDevice,
)
from tests.system.station import BASE, Listener, listening

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from jointfit_protocols.natnet import Message
    from tests.broker_fixture import Broker

pytestmark = pytest.mark.system

RATE_HZ = 100
RIG = """
[rig]
name = "attacked"
[chain]
joints = ["hip", "knee"]
segments = ["thigh"]
[[imu]]
id = "S1"
segment = "thigh"
driver = "xbus"
port = "{folder}/S1"
[mocap]
driver = "natnet"
server = "127.0.0.1"
command_port = {mocap}
silence_s = 2.0
markers.thigh = ["T1", "T2", "T3"]
[mqtt]
host = "127.0.0.1"
port = {mqtt}
base = "{base}"
health_s = 0.3
"""
MARKERS = {"T1": (0.1, 0.2, 0.3), "T2": (0.2, 0.2, 0.3), "T3": (0.1, 0.3, 0.3)}
INFO = ServerInfo("Attacker", (3, 0, 0, 0), (3, 1, 0, 0), 2**60)
NAMES = ModelDefinition((MarkerSetDescription("x", ("",) * 60_000),))
LARGEST = b"\x05\x00\xdf\xff" + b"\xff" * 65_503
CONTROL: tuple[bytes, ...] = (
    encode(INFO),
    encode(INFO._replace(clock_hz=10_000_000)),
    encode(CommandResponse(b"Bitstream,2.9\0")),
    encode(CommandResponse(b"Bitstream,99.99\0")),
    encode(NAMES),
    LARGEST,
    b"",
    b"\x07",
    bytes(200),
    *(bytes((kind, 0, 4, 0)) + b"\xff" * 4 for kind in NatNetMessageId),
)
"""Messages that try to change or end the session."""


class AttackedCameras:
    """Camera server and one IMU; the frames of the server can be made undecodable."""

    def __init__(self, folder: Path) -> None:
        self.readable = True
        body = RigidBodyAsset("Thigh", tuple(MARKERS), 1)
        self.server = NatNetServer(NatNetServerOptions(bodies=(body,), wire_noise=self._noise))
        self.sensor = XbusDevice(folder / "S1")

    def _noise(self, data: bytes) -> bytes:
        return data if self.readable else data[:40] + bytes(len(data) - 40)

    async def run(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self.server.run())
            tasks.create_task(self.sensor.run())
            for number in itertools.count():
                t_ns, half = time.monotonic_ns(), 0.2 * math.sin(0.05 * number)
                self.sensor.push(t_ns, (math.cos(half), math.sin(half), 0.0, 0.0))
                self.server.push(t_ns, MARKERS, {})
                await asyncio.sleep(1 / RATE_HZ)

    @property
    def client(self) -> tuple[str, int]:
        """Address of the daemon's socket."""
        return self.server.clients[0].address

    def forge(self, message: Message | bytes) -> None:
        """Send to the daemon from the address and port of the server, like a spoofed sender."""
        data = message if isinstance(message, bytes) else encode(message)
        self.server._port.send(data, self.client)


@contextlib.asynccontextmanager
async def attacked(folder: Path, mqtt: int) -> AsyncIterator[tuple[AttackedCameras, Listener]]:
    """Yield cameras and listener once the daemon receives both sources; check that it survives."""
    cameras = AttackedCameras(folder)
    task = asyncio.create_task(cameras.run())
    rig = folder / "rig.toml"
    mocap = cameras.server.command_port
    rig.write_text(RIG.format(folder=folder, mocap=mocap, mqtt=mqtt, base=BASE), encoding="utf-8")
    try:
        async with daemon(folder, rig) as child, listening(mqtt) as listener:
            await listener.connected({"S1", "mocap"})
            await listener.health(lambda devices: devices["mocap"]["clock"] == "echo")
            yield cameras, listener
            child.check()
    finally:
        task.cancel()
        await asyncio.wait([task])
        cameras.sensor.unplug()
        cameras.server.unplug()


async def check_frames(listener: Listener) -> None:
    """Check that frames and poses still arrive, and that the clock still uses echoes."""
    before = listener.latest["bridge/health"]["devices"]["mocap"]
    received = before["received"]
    after = (await listener.health(lambda d: d["mocap"]["received"] > received + 20))["mocap"]
    assert (after["clock"], after["epoch"], after["reconnects"]) == ("echo", before["epoch"], 0)
    await listener.more_poses()


def udp(address: str) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.bind((address, 0))
    return opened


@pytest.mark.timeout(180)
@pytest.mark.parametrize("address", ["127.0.0.1", "127.0.0.2"])
async def test_datagrams_from_another_port_or_address_have_no_effect(
    tmp_path: Path, broker: Broker, address: str
) -> None:
    async with attacked(tmp_path, broker.port) as (cameras, listener):
        with udp(address) as attacker:
            for number in range(300):
                for data in CONTROL:
                    attacker.sendto(data, cameras.client)
                now_ns = time.monotonic_ns()
                forged = EchoResponse(now_ns - 1_000_000, now_ns + number * 10**9)
                attacker.sendto(encode(forged), cameras.client)
                await asyncio.sleep(0.002)
        await check_frames(listener)
        await listener.connected({"S1", "mocap"})
        assert listener.find_event("mocap", "Attacker") is None


@pytest.mark.timeout(180)
async def test_forged_answers_of_the_camera_server_do_not_stop_its_frames(
    tmp_path: Path, broker: Broker
) -> None:
    async with attacked(tmp_path, broker.port) as (cameras, listener):
        for _ in range(20):
            for data in CONTROL:
                cameras.forge(data)
            cameras.forge(EchoResponse(time.monotonic_ns() - 10**6, 2**63))
            await asyncio.sleep(0.01)
        await check_frames(listener)
        await listener.connected({"mocap"})


@pytest.mark.timeout(180)
async def test_cameras_are_offline_while_their_frames_cannot_be_decoded(
    tmp_path: Path, broker: Broker
) -> None:
    async with attacked(tmp_path, broker.port) as (cameras, listener):
        cameras.readable = False
        await listener.event("mocap", "none could be decoded as NatNet 3.1", "check that Motive")
        health = await listener.health(lambda devices: not devices["mocap"]["online"])
        assert health["mocap"]["discarded_bytes"] > 0
        cameras.readable = True
        await listener.connected({"S1", "mocap"})


@pytest.mark.timeout(180)
async def test_camera_server_with_an_impossible_clock_frequency_is_rejected(
    tmp_path: Path, broker: Broker
) -> None:
    async with attacked(tmp_path, broker.port) as (cameras, listener):
        options = replace(cameras.server.options, clock_hz=2**53, device_ns=lambda _: 10**9)
        cameras.server.unplug()
        await listener.disconnected({"mocap"})
        cameras.server.options = options
        cameras.server.plug()
        await listener.event("mocap", "clock frequency of 9007199254740992 Hz, expected 1000")
        await listener.more_poses()
