"""No sample is lost track of, from the simulator's wire to the last verdict."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from tests.system.station import SENSORS, Station, listening, running, unbalanced

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.tools.child_processes import Simulator
    from tests.broker_fixture import Broker
    from tests.system.station import Listener

pytestmark = [pytest.mark.system, pytest.mark.alone]

NOISY = (
    "--set", "dropout=0.02", "--set", "line_flip_per_byte=0.0004",
    "--set", "line_burst_per_byte=0.0002",
)  # fmt: skip
WIRES = (("S1",), ("S3",), ("S2", "S4"))
"""What is broken on a bus is counted once, by one of the sensors on it."""
QUIET = ("--set", "dropout=0.02", "--set", "latency_jitter_ms=3")


async def all_gone(listener: Listener) -> dict[str, Any]:
    """Return the counters once every stream has stopped and every sample has its verdict."""
    await listener.until(lambda: not listener.online)
    return await listener.health(lambda devices: not any(d["online"] for d in devices.values()))


async def replugged(simulator: Simulator, listener: Listener, name: str, *worn: str) -> None:
    await simulator.say(f"unplug {name}")
    await listener.until(lambda: not set(worn) & listener.online)
    await simulator.say(f"plug {name}")
    await listener.connected(set(worn))


@pytest.mark.timeout(60)
async def test_every_sample_of_a_noisy_run_has_one_verdict(tmp_path: Path, broker: Broker) -> None:
    station = Station(tmp_path, broker.port, options=NOISY)
    async with running(station) as (simulator, _, listener):
        await asyncio.sleep(3)
        await replugged(simulator, listener, "S1", "S1")
        await replugged(simulator, listener, "can0", "S2", "S4")
        await asyncio.sleep(2)
        said = await simulator.quit()
        devices = await all_gone(listener)
    assert unbalanced(devices) == {}
    assert all(devices[name]["reconnects"] == 1 for name in ("S1", "S2", "S4")), devices
    for wire in WIRES:
        assert sum(devices[name]["corrupt"] for name in wire) > 0, wire
        assert sum(devices[name]["discarded_bytes"] for name in wire) > 0, wire
    for name in SENSORS:
        assert devices[name]["used"] > 300, devices[name]
        sent = said["sent"][name]
        assert sent > devices[name]["received"] > 0.7 * sent, (name, sent, devices[name])


@pytest.mark.timeout(60)
async def test_without_line_noise_all_that_was_sent_is_received_and_the_rest_known_lost(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port, options=QUIET)
    async with station.simulator() as simulator, station.daemon(), listening(broker.port) as ear:
        await ear.connected({*SENSORS, "mocap"})
        await asyncio.sleep(6)
        said = await simulator.quit()
        devices = await all_gone(ear)
    assert unbalanced(devices) == {}
    assert {name: device["received"] for name, device in devices.items()} == said["sent"]
    assert all(devices[name]["corrupt"] == 0 for name in devices)
    for name in SENSORS:
        dropped = said["dropped_out"][name]
        assert dropped > 3
        # What dropped out before the first sample or after the last leaves no gap to be seen.
        assert dropped - 2 <= devices[name]["lost"] <= dropped, (name, devices[name])
        assert devices[name]["used"] > 0.95 * devices[name]["received"]
