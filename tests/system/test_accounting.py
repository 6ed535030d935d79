"""Each sample is counted with one outcome, from the simulator's wire to the health messages."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.system.station import SENSORS, Station, load_factor, running, unbalanced

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.tools.child_processes import Simulator
    from tests.broker_fixture import Broker
    from tests.system.station import Listener

pytestmark = pytest.mark.system

NOISY = (
    "--set", "dropout=0.02", "--set", "line_flip_per_byte=0.0004",
    "--set", "line_burst_per_byte=0.0002",
)  # fmt: skip
WIRES = (("S1",), ("S3",), ("S2", "S4"))
"""Sensors by wire. Corrupt bytes on a bus are counted by one of its sensors."""
USED = 0.95
"""Smallest accepted share of the received samples that are used, or on a loaded machine used or
late."""
OVERLOAD = 1.5
"""Load factor above which the load of the machine makes many samples late."""
DROPOUTS = ("--set", "dropout=0.02", "--set", "latency_jitter_ms=3")


async def wait_for_samples(listener: Listener, count: int) -> None:
    """Wait until `count` samples of each sensor were used."""
    await listener.health(lambda devices: all(devices[name]["used"] > count for name in SENSORS))


async def replug(simulator: Simulator, listener: Listener, wire: str, *sensors: str) -> None:
    await simulator.send_command(f"unplug {wire}")
    await listener.disconnected(sensors)
    await simulator.send_command(f"plug {wire}")
    await listener.connected(sensors)


@pytest.mark.timeout(180)
async def test_every_sample_of_a_noisy_run_has_one_outcome(tmp_path: Path, broker: Broker) -> None:
    station = Station(tmp_path, broker.port, options=NOISY)
    async with running(station) as (simulator, _, listener):
        await wait_for_samples(listener, 200)
        await replug(simulator, listener, "S1", "S1")
        await replug(simulator, listener, "can0", "S2", "S4")
        await wait_for_samples(listener, 400)
        sent = (await simulator.quit())["sent"]
        devices = await listener.final_health()

    assert unbalanced(devices) == {}
    assert all(devices[name]["reconnects"] == 1 for name in ("S1", "S2", "S4")), devices
    for wire in WIRES:
        assert sum(devices[name]["corrupt"] for name in wire) > 0, wire
        assert sum(devices[name]["discarded_bytes"] for name in wire) > 0, wire
    for name in SENSORS:
        received = devices[name]["received"]
        assert sent[name] > received > 0.7 * sent[name], (name, sent[name], devices[name])


@pytest.mark.timeout(180)
async def test_samples_sent_on_a_noiseless_line_are_received_and_dropouts_are_counted_as_lost(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port, options=DROPOUTS)
    async with running(station) as (simulator, _, listener):
        await wait_for_samples(listener, 500)
        account = await simulator.quit()
        devices = await listener.final_health()

    assert unbalanced(devices) == {}
    assert {name: device["received"] for name, device in devices.items()} == account["sent"]
    assert all(devices[name]["corrupt"] == 0 for name in devices)
    for name in SENSORS:
        dropped = account["dropped_out"][name]
        assert dropped > 3
        # Dropouts before the first sample or after the last leave no gap in the counter.
        assert dropped - 2 <= devices[name]["lost"] <= dropped, (name, devices[name])
        received, used, late = (devices[name][key] for key in ("received", "used", "late"))
        assert used + late > USED * received, devices[name]
        assert used > USED * received or load_factor() > OVERLOAD, devices[name]
