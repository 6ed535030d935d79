"""Recordings of real devices, replayed at their timing through the daemon process.

The recorded Xsens messages are written to a pty after a handshake, the recorded NatNet frames to a
socket. The counters are read from the health messages.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.tools.child_processes import daemon
from tests.captured_datagrams import read_udp
from tests.simulators.natnet_replay import NatNetReplay
from tests.simulators.xbus_replay import XbusReplay
from tests.system.station import OUTCOMES, TOPICS, Listener, listening

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]

BASE = "jointfit/captures"
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


@asynccontextmanager
async def gateway(
    folder: Path, broker: Broker, device: XbusReplay, server: NatNetReplay | None = None
) -> AsyncIterator[Listener]:
    """Run the daemon on replayed recordings of an IMU and, optionally, a camera server."""
    rig = folder / "rig.toml"
    mocap = MOCAP.format(port=server.command_port) if server else ""
    rig.write_text(RIG.format(port=folder / "imu", mocap=mocap, broker=broker.port))
    async with listening(broker.port, BASE, (*TOPICS, "device/+/info")) as listener:
        tasks = [asyncio.create_task(device.run())]
        tasks += [asyncio.create_task(server.run())] if server else []
        try:
            async with daemon(folder, rig):
                yield listener
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
            device.unplug()
            if server:
                server.unplug()


async def read_infos(listener: Listener, *names: str) -> list[dict[str, Any]]:
    """Wait for the info messages of devices; return them."""
    topics = [f"device/{name}/info" for name in names]
    await listener.until(lambda: all(topic in listener.latest for topic in topics))
    return [listener.latest[topic] for topic in topics]


def xsens(shared_data: Path, number: int) -> bytes:
    return (shared_data / "imu" / "xsens" / f"{number}.output.bin").read_bytes()


async def test_samples_of_recorded_imu_and_camera_streams_are_all_counted(
    tmp_path: Path, shared_data: Path, broker: Broker
) -> None:
    device = XbusReplay(tmp_path / "imu", xsens(shared_data, 5))
    traffic = shared_data / "mocap/natnet_v3_mje-nz/test_data/raw/traffic.pcapng"
    server = NatNetReplay((p.t_ns, p.payload) for p in read_udp(traffic.read_bytes()))
    async with gateway(tmp_path, broker, device, server) as listener:
        began = time.monotonic()
        await device.play()
        took_s = time.monotonic() - began
        devices = await listener.health(
            lambda devices: (
                devices["mocap"]["received"] == 518
                and devices["S1"]["received"] == 92
                and devices["S1"]["pending"] == 0
            )
        )
        imu_info, mocap_info = await read_infos(listener, "S1", "mocap")

    assert device.messages == device.sent == 100
    assert took_s > 0.92  # the timing of the recording
    assert server.sent == server.frames == 518
    for name, received in (("S1", 92), ("mocap", 518)):
        counts = devices[name]
        assert sum(counts[outcome] for outcome in (*OUTCOMES, "pending")) == received
        for count in ("lost", "restarts", "corrupt", "discarded_bytes", "late", "duplicate"):
            assert counts[count] == 0, (name, count)

    assert (imu_info["serial"], imu_info["model"]) == ("0360A1B2", "MTi-3-8A7G6")
    assert imu_info["outputs"]["0x2010"] == 100
    assert mocap_info["model"] == "Motive"
    assert (mocap_info["firmware"], mocap_info["natnet"]) == ("2.1.0.0", "3.0.0.0")
    assert mocap_info["clock_hz"] == 3_312_787
    assert mocap_info["bodies"] == ["RaceQuad"]
    assert mocap_info["markers"] == [f"Marker{number}" for number in range(1, 6)]


@pytest.mark.parametrize("number", [1, 3])
async def test_recorded_stream_without_quaternions_yields_neither_samples_nor_corrupt_bytes(
    tmp_path: Path, shared_data: Path, broker: Broker, number: int
) -> None:
    device = XbusReplay(tmp_path / "imu", xsens(shared_data, number))
    async with gateway(tmp_path, broker, device) as listener:
        await device.play()
        assert device.sent == 100
        await listener.event("S1", "silent for 1 s")
        devices = await listener.health(
            lambda devices: (
                devices["S1"]["last_age_ms"] is not None and devices["S1"]["online"] is False
            )
        )
        (info,) = await read_infos(listener, "S1")

    assert info["serial"] == "0360A1B2"
    for count in ("received", "lost", "restarts", "corrupt", "discarded_bytes"):
        assert devices["S1"][count] == 0, count
