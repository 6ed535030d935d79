"""Stops, restarts and losses of everything around the daemon."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.outputs.mqtt import MqttClient
from tests.system.station import (
    SENSORS,
    Station,
    broker,
    hang_up,
    listening,
    running,
    stopped,
)

if TYPE_CHECKING:
    from pathlib import Path

    from tests.broker_fixture import Broker

pytestmark = pytest.mark.system

EVERYONE = {*SENSORS, "mocap"}
OFFLINE, ONLINE = {"v": 1, "state": "offline"}, {"v": 1, "state": "online"}


async def retained(port: int, count: int) -> dict[str, Any]:
    """Return what a late subscriber finds: state, info, calibration and availabilities."""
    found: dict[str, Any] = {}
    async with asyncio.timeout(5), MqttClient(broker(port)) as client:
        await client.subscribe(
            "bridge/state", "bridge/info", "calibration", "device/+/availability"
        )
        async for topic, payload in client.messages():
            found[topic] = payload
            if len(found) == count:
                break
    return found


@pytest.mark.timeout(60)
async def test_sigterm_under_load_stops_in_time_and_leaves_everything_offline(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port, options=("--rate", "400"))
    async with running(station) as (_, daemon, listener):
        await listener.more_poses(100)
        code, took_s = await stopped(daemon)
        assert code == 0, station.log
        assert took_s < 5
    left = await retained(broker.port, 3 + len(EVERYONE))
    assert left["bridge/state"] == OFFLINE
    assert {name for name in EVERYONE if left[f"device/{name}/availability"] == OFFLINE} == EVERYONE
    assert "Traceback" not in station.log


@pytest.mark.timeout(60)
async def test_the_broker_may_come_late_and_restart(tmp_path: Path, broker: Broker) -> None:
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
            broker.start()  # nothing is retained: it was killed
            await listener.connected(EVERYONE, 8)
            await listener.more_poses(50)
            found = await retained(broker.port, 3 + len(EVERYONE))
            assert found["bridge/state"] == ONLINE
            assert found["bridge/info"]["rig"] == "demo"
            assert found["calibration"]["phase"] == "uncalibrated"
            assert all(found[f"device/{name}/availability"] == ONLINE for name in EVERYONE)
            broker.stop()
            await asyncio.sleep(0.5)
        code, _ = await stopped(daemon)
        assert code == 0, station.log
    assert "Traceback" not in station.log


@pytest.mark.timeout(60)
async def test_a_killed_simulator_and_a_broken_reload_cost_only_what_was_lost(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port)
    async with station.simulator() as first, station.daemon() as daemon:
        async with listening(broker.port) as listener:
            await listener.connected(EVERYONE)
            assert first.process is not None
            first.process.kill()
            await listener.until(lambda: not listener.online)
            async with Station(tmp_path, broker.port).simulator():
                await listener.connected(set(SENSORS), 2.5)
                await broken_reload(station, listener, daemon)
                station.write_rig()  # cameras came back on another port
                hang_up(daemon)
                await listener.connected(EVERYONE, 8)
        code, _ = await stopped(daemon)
        assert code == 0, station.log


async def broken_reload(station: Station, listener: Any, daemon: Any) -> None:
    """SIGHUP with a broken file is refused with all its faults, and everything goes on."""
    before = station.rig.read_text(encoding="utf-8")
    station.rig.write_text(before.replace("[rig]", "[rgi]"), encoding="utf-8")
    hang_up(daemon)
    await listener.until(
        lambda: listener.said(
            "demo", "refused, the running configuration stays in force", "did you mean 'rig'?"
        )
    )
    poses = await listener.more_poses(50)
    seqs = [pose["seq"] for pose in poses]
    assert seqs == list(range(seqs[0], seqs[0] + len(seqs)))
    assert set(SENSORS) <= listener.online
