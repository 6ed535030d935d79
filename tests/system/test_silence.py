"""Poses while every IMU is silent: published at the output rate, with the flags held and lost."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.outputs.recording import encode_state, open_recording, read_events
from tests.pipeline.core_feed import replay_states
from tests.system.station import (
    SENSORS,
    Listener,
    Station,
    listening,
    load_factor,
    sensors_in,
    stopped,
    store_calibration,
    unbalanced,
)

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.tools.child_processes import Simulator
    from tests.broker_fixture import Broker

pytestmark = pytest.mark.system

WIRES = ("S1", "S3", "can0")
PERIOD_US = 10_000
LOST = ["lost:thigh", "lost:shank"]
HELD = ["held:thigh", "held:shank"]
OUTPUT_HZ = 100


async def send_for_all(simulator: Simulator, command: str) -> None:
    """Send a command of the simulator for every wire."""
    for wire in WIRES:
        await simulator.send_command(f"{command} {wire}")


def silent_flags(pose: dict[str, Any]) -> list[str]:
    """Return the flags of segments without a sensor."""
    return [flag for flag in pose["flags"] if flag.startswith(("held", "lost"))]


async def pose_with(listener: Listener, *flags: str) -> dict[str, Any]:
    """Wait for a further pose with exactly these flags of silent segments; return it."""
    begin = len(listener.poses)

    def found() -> list[dict[str, Any]]:
        return [pose for pose in listener.poses[begin:] if silent_flags(pose) == [*flags]]

    await listener.until(found)
    return found()[0]


async def wait_for_all_sensors(listener: Listener) -> None:
    """Wait for a pose to which all sensors contribute."""
    await listener.until(lambda: sensors_in(listener.poses[-1]) == set(SENSORS))


def is_unknown(pose: dict[str, Any]) -> bool:
    knee = pose["joints"]["knee"]
    parts = pose["segments"].values()
    return knee["inner_deg"] is None and all(part["q"] is None for part in parts)


@pytest.mark.timeout(180)
async def test_poses_continue_as_held_then_lost_while_all_imus_are_silent(
    tmp_path: Path, broker: Broker
) -> None:
    motion = ("--seed", "1", "--programme", "walk:600")
    station = Station(tmp_path, broker.port, options=motion, more_toml="[recording]\n")
    async with station.simulator() as simulator:
        await send_for_all(simulator, "unplug")
        store_calibration(station.rig, tmp_path / "state")
        async with station.daemon() as daemon, listening(broker.port) as listener:
            await listener.connected({"mocap"})
            assert is_unknown(await pose_with(listener, *LOST))  # before the first IMU sample

            await send_for_all(simulator, "plug")
            await listener.connected(SENSORS)
            await wait_for_all_sensors(listener)
            # After the silence, the daemon must detect that no CAN sensor restarted. This requires
            # more than a few samples from before the silence.
            await listener.health(lambda d: all(d[name]["received"] >= 50 for name in SENSORS))

            begin = len(listener.poses)
            await send_for_all(simulator, "unplug")
            await listener.disconnected(SENSORS)
            await pose_with(listener, *LOST)
            (held, *_) = [pose for pose in listener.poses[begin:] if silent_flags(pose) == HELD]
            assert held["joints"]["knee"]["inner_deg"] is not None
            assert held["joints"]["knee"]["flexion_deg_s"] is None
            silent = await listener.more_poses(2 * OUTPUT_HZ, 4.0 * load_factor())
            assert all(is_unknown(pose) and not sensors_in(pose) for pose in silent)
            assert "imu+mocap" in {pose["mode"] for pose in silent}
            assert listener.latest["bridge/state"]["state"] == "online"

            await send_for_all(simulator, "plug")
            await wait_for_all_sensors(listener)
            await listener.more_poses(OUTPUT_HZ)
            await listener.connected(SENSORS)
            devices = await listener.health(lambda d: all(d[name]["online"] for name in SENSORS))
            assert [devices[name]["reconnects"] for name in SENSORS] == [1, 1, 1, 1]
            restarts = [devices[name]["restarts"] for name in SENSORS]
            assert restarts == [0, 0, 0, 0], listener.format_events()
            assert not [e for e in listener.events if "then the static pose" in e["text"]]

            await simulator.send_command("reboot S1")
            await listener.event("S1", "then the static pose")
            await listener.health(lambda d: d["S1"]["restarts"] == 1)
            await simulator.quit()
            devices = await listener.final_health()
            code, _ = await stopped(daemon)

    assert code == 0, station.log
    assert station.log.count("calibration calibrated: stored calibration loaded (version 1 in") == 1
    assert unbalanced(devices) == {}
    steps = [
        (b["mono_us"] - a["mono_us"], b["seq"] - a["seq"]) for a, b in pairwise(listener.poses)
    ]
    assert all(seq >= 1 and us == PERIOD_US * seq for us, seq in steps), set(steps)
    (log,) = (tmp_path / "state" / "recordings").iterdir()
    live = list(open_recording(log).states())
    assert len(live) > 5 * OUTPUT_HZ
    assert [encode_state(state) for state in replay_states(read_events(log))] == live
