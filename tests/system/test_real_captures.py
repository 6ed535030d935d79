"""What real devices sent, at its own timing, through the real daemon: the known counts come out.

The recorded Xsens messages go into a pty after a handshake, the recorded NatNet frames into a
socket; every count is read where a user reads it, at the broker.
"""

from __future__ import annotations

import asyncio
import json
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.config import MqttSettings
from jointfit_daemon.files.captures._packet_capture import read_udp
from jointfit_daemon.outputs.mqtt import MqttClient
from jointfit_daemon.tools.child_processes import daemon
from jointfit_simulators.devices._natnet_replay import NatNetReplay
from jointfit_simulators.devices._xbus_replay import XbusReplay

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.timeout(60)]

BASE = "jointfit/captures"
TOPICS = ("bridge/health", "bridge/event", "bridge/log", "device/+/info", "device/+/availability")
VERDICTS = ("used", "decimated", "idle", "late", "duplicate", "dropped", "pending")
RIG = """
[rig]
name = "captures"
[chain]
joints = ["hip", "knee"]
segments = ["thigh"]
[[imu]]
id = "S1"
segment = "thigh"
driver = "xbus"
port = "{port}"
baud = 921600
rate_hz = 100
{mocap}
[mqtt]
host = "127.0.0.1"
port = {broker}
base = "jointfit/captures"
health_s = 0.5
"""
MOCAP = """
[mocap]
driver = "natnet"
server = "127.0.0.1"
command_port = {port}
up_axis = "y"
rigid_body.thigh = "RaceQuad"
"""


class Heard:
    """The newest of every topic, and all that was told."""

    def __init__(self) -> None:
        self.latest: dict[str, Any] = {}
        self.texts: list[str] = []

    async def listen(self, client: MqttClient) -> None:
        async for topic, payload in client.messages():
            self.latest[topic] = payload
            if topic in {"bridge/event", "bridge/log"}:
                self.texts.append(json.dumps(payload))

    def device(self, name: str) -> dict[str, Any]:
        health = self.latest.get("bridge/health", {"devices": {}})
        found: dict[str, Any] = health["devices"].get(name, {})
        return found

    async def until(self, condition: Callable[[], object], within_s: float = 15.0) -> None:
        try:
            async with asyncio.timeout(within_s):
                while not condition():
                    await asyncio.sleep(0.05)
        except TimeoutError:
            told = "\n".join(self.texts)
            raise AssertionError(f"{self.latest.get('bridge/health')}\n{told}") from None


@asynccontextmanager
async def gateway(
    folder: Path, broker: Broker, device: XbusReplay, server: NatNetReplay | None = None
) -> AsyncIterator[Heard]:
    """Run the daemon on a device and perhaps a server of recordings; yield what is heard of it."""
    rig = folder / "rig.toml"
    mocap = MOCAP.format(port=server.command_port) if server else ""
    rig.write_text(RIG.format(port=folder / "imu", mocap=mocap, broker=broker.port))
    heard = Heard()
    async with MqttClient(MqttSettings(host="127.0.0.1", port=broker.port, base=BASE)) as client:
        await client.subscribe(*TOPICS)
        tasks = [asyncio.create_task(heard.listen(client)), asyncio.create_task(device.run())]
        tasks += [asyncio.create_task(server.run())] if server else []
        try:
            async with daemon(folder, rig):
                yield heard
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
            device.unplug()
            if server:
                server.unplug()


def xsens(shared_data: Path, number: int) -> bytes:
    return (shared_data / "imu" / "xsens" / f"{number}.output.bin").read_bytes()


async def test_real_quaternions_and_real_camera_frames_are_counted_to_the_last_one(
    tmp_path: Path, shared_data: Path, broker: Broker
) -> None:
    device = XbusReplay(tmp_path / "imu", xsens(shared_data, 5))
    traffic = shared_data / "mocap/natnet_v3_mje-nz/test_data/raw/traffic.pcapng"
    server = NatNetReplay((p.t_ns, p.payload) for p in read_udp(traffic.read_bytes()))
    async with gateway(tmp_path, broker, device, server) as heard:
        began = time.monotonic()
        await device.play()
        took_s = time.monotonic() - began
        await heard.until(lambda: heard.device("mocap").get("received") == 518)
        await heard.until(lambda: heard.device("S1").get("pending") == 0)
        imu, mocap = heard.device("S1"), heard.device("mocap")
        infos = {name: heard.latest[f"device/{name}/info"] for name in ("S1", "mocap")}
    assert device.messages == device.sent == 100
    assert took_s > 0.92  # its own timing
    assert imu["received"] == sum(imu[verdict] for verdict in VERDICTS) == 92
    for count in ("lost", "restarts", "corrupt", "discarded_bytes", "late", "duplicate"):
        assert imu[count] == 0, count
    assert server.sent == server.frames == 518
    assert mocap["received"] == sum(mocap[verdict] for verdict in VERDICTS) == 518
    for count in ("lost", "restarts", "corrupt", "discarded_bytes", "late", "duplicate"):
        assert mocap[count] == 0, count
    said = infos["S1"]
    assert (said["serial"], said["model"]) == ("0360A1B2", "MTi-3-8A7G6")
    assert said["outputs"]["0x2010"] == 100
    said = infos["mocap"]
    assert (said["model"], said["firmware"], said["natnet"]) == ("Motive", "2.1.0.0", "3.0.0.0")
    assert said["clock_hz"] == 3_312_787
    assert said["bodies"] == ["RaceQuad"]
    assert said["markers"] == [f"Marker{number}" for number in range(1, 6)]


@pytest.mark.parametrize("number", [1, 3])
async def test_a_real_stream_without_quaternions_gives_no_sample_and_no_corruption(
    tmp_path: Path, shared_data: Path, broker: Broker, number: int
) -> None:
    device = XbusReplay(tmp_path / "imu", xsens(shared_data, number))
    async with gateway(tmp_path, broker, device) as heard:
        await device.play()
        assert device.sent == 100
        await heard.until(lambda: any("silent for 1 s" in text for text in heard.texts))
        await heard.until(lambda: heard.device("S1").get("last_age_ms") is not None)
        imu = heard.device("S1")
        assert heard.latest["device/S1/info"]["serial"] == "0360A1B2"
    assert imu["online"] is False
    for count in ("received", "lost", "restarts", "corrupt", "discarded_bytes"):
        assert imu[count] == 0, count
