"""The daemon stops in time, and survives restarts and losses of the broker and the simulator."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.outputs.mqtt import MqttClient
from tests.system.station import (
    PATIENCE_S,
    SENSORS,
    Listener,
    Station,
    broker,
    hang_up,
    listening,
    load_factor,
    running,
    stopped,
)

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.tools.child_processes import ChildProcess
    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]

SOURCES = {*SENSORS, "mocap"}
RETAINED = ("bridge/state", "bridge/info", "calibration")
OFFLINE, ONLINE = {"v": 1, "state": "offline"}, {"v": 1, "state": "online"}
STOP_S = 5.0
"""Longest accepted time from SIGTERM to the exit, s."""
DEVICE_BACK_S = 2.5
"""Longest accepted time from the return of devices to their state online, s."""


async def read_retained(port: int) -> dict[str, Any]:
    """Return the retained messages that a new subscriber receives, by topic."""
    found: dict[str, Any] = {}
    async with asyncio.timeout(PATIENCE_S), MqttClient(broker(port)) as client:
        await client.subscribe(*RETAINED, "device/+/availability")
        async for topic, payload in client.messages():
            found[topic] = payload
            if len(found) == len(RETAINED) + len(SOURCES):
                break
    return found


async def test_sigterm_at_full_rate_stops_the_daemon_in_time_and_marks_everything_offline(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port, options=("--rate", "400"))
    async with running(station) as (_, daemon, listener):
        await listener.more_poses(100)
        code, took_s = await stopped(daemon)
        assert code == 0, station.log
        assert took_s < STOP_S * load_factor()

    retained = await read_retained(broker.port)
    assert retained["bridge/state"] == OFFLINE
    assert {retained[f"device/{name}/availability"]["state"] for name in SOURCES} == {"offline"}
    assert "Traceback" not in station.log


async def test_daemon_connects_to_a_late_broker_and_reconnects_to_a_restarted_one(
    tmp_path: Path, broker: Broker
) -> None:
    broker.stop()
    station = Station(tmp_path, broker.port)
    async with (
        station.simulator(),
        station.daemon() as daemon,
        listening(broker.port) as listener,
    ):
        await asyncio.sleep(2.5)
        daemon.check()

        for _ in range(2):
            listener.latest.clear()
            broker.start()  # the retained messages were lost
            await listener.connected(SOURCES)
            await listener.more_poses(50)
            retained = await read_retained(broker.port)
            assert retained["bridge/state"] == ONLINE
            assert retained["bridge/info"]["rig"] == "demo"
            assert retained["calibration"]["phase"] == "uncalibrated"
            assert all(retained[f"device/{name}/availability"] == ONLINE for name in SOURCES)
            broker.stop()
            await listener.until(lambda: listener.client is None)

        code, _ = await stopped(daemon)
        assert code == 0, station.log
    assert "Traceback" not in station.log


async def test_daemon_recovers_from_a_killed_simulator_and_rejects_a_broken_reload(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port)
    async with station.simulator() as first, station.daemon() as daemon:
        async with listening(broker.port) as listener:
            await listener.connected(SOURCES)
            assert first.process is not None
            first.process.kill()
            await listener.until(lambda: not listener.online)

            async with Station(tmp_path, broker.port).simulator():
                await listener.connected(SENSORS, DEVICE_BACK_S * load_factor())
                await reload_broken_rig(station, listener, daemon)
                station.write_rig()  # the cameras have another port now
                hang_up(daemon)
                await listener.connected(SOURCES)
        code, _ = await stopped(daemon)
        assert code == 0, station.log


async def reload_broken_rig(station: Station, listener: Listener, daemon: ChildProcess) -> None:
    """Check that a reload of an invalid file is rejected and that no pose is missing."""
    before = station.rig.read_text(encoding="utf-8")
    station.rig.write_text(before.replace("[rig]", "[rgi]"), encoding="utf-8")
    hang_up(daemon)
    await listener.event(
        "demo", "refused, the running configuration stays in force", "did you mean 'rig'?"
    )
    poses = await listener.more_poses(50)
    seqs = [pose["seq"] for pose in poses]
    assert seqs == list(range(seqs[0], seqs[0] + len(seqs)))
    await listener.connected(SENSORS)
