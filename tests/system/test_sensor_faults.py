"""Worn sensors that fail under the real daemon: told in time, lived through, told to be over."""

from __future__ import annotations

import re
import statistics
import time
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest

from bench.subjects.simulated_wearer import bench_rig, fitted
from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.config import load_rig
from tests.system.station import Listener, Station, knee_angles, listening, sensors_in

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.tools.child_processes import Simulator
    from tests.broker_fixture import Broker

pytestmark = [pytest.mark.system, pytest.mark.alone]

SECOND = 1_000_000
BLOCK_S = 0.2
"""A mishap begins with the simulator's next block."""
FAULT_S, SLIP_S, PAUSE_S = 0.5 + BLOCK_S, 2.0 + BLOCK_S, 0.5
BACK_S = 8.0
"""A sensor must do well for 2 s before it is told to be back; the machine may be busy."""
MOST = 0.8
DOUBT = re.compile("stuck|slipped|pair_disagrees|heading_disagrees")


def told(listener: Listener, name: str, state: str, since_us: int) -> dict[str, Any] | None:
    """Return the first event of that kind since then."""
    for event in listener.events:
        said = event["kind"], event["id"], event["data"].get("state")
        if said == ("sensor", name, state) and event["t_us"] >= since_us:
            return event
    return None


async def happens(
    listener: Listener, simulator: Simulator, command: str, name: str, state: str
) -> tuple[float, list[dict[str, Any]]]:
    """Give a command, wait for what is told; return how long it took (s), and poses after it."""
    began_us = time.time_ns() // 1000
    await simulator.say(command)
    await listener.until(lambda: told(listener, name, state, began_us), BACK_S)
    event = told(listener, name, state, began_us)
    assert event is not None
    return (event["t_us"] - began_us) / SECOND, await listener.more_poses(50)


def deviation(poses: list[dict[str, Any]], segment: str) -> float:
    found = [pose["segments"][segment]["sd_deg"] for pose in poses]
    return statistics.median(float(sd) for sd in found if sd is not None)


def share(poses: list[dict[str, Any]], flag: str) -> float:
    """Return how many poses have a flag; a busy machine may spoil single ones."""
    return sum(flag in pose["flags"] for pose in poses) / len(poses)


def longest_pause_s(poses: list[dict[str, Any]]) -> float:
    return max(float(b["t_us"] - a["t_us"]) for a, b in pairwise(poses)) / SECOND


@pytest.mark.timeout(90)
async def test_sensors_that_fail_are_told_lived_through_and_told_to_be_back(
    tmp_path: Path, broker: Broker
) -> None:
    calibration = fitted(bench_rig())  # of the very wearer whom the simulator plays
    programme = ("--seed", "1", "--no-mocap", "--programme", "walk:600")
    station = Station(tmp_path, broker.port, options=programme)
    async with station.simulator() as simulator:
        store = load_rig(station.rig).calibration_store
        CalibrationStore(tmp_path / "state" / "calibrations", store).save(calibration)
        async with station.daemon(), listening(broker.port) as listener:
            await listener.connected({"S1", "S2", "S3", "S4"})
            await listener.until(lambda: listener.poses and listener.poses[-1]["sync"] == "locked")
            healthy = await listener.more_poses(150)
            assert not {flag for pose in healthy for flag in pose["flags"] if DOUBT.match(flag)}

            took_s, poses = await happens(listener, simulator, "unplug S2", "S2", "lost")
            assert took_s < FAULT_S
            assert share(poses, "one_sensor:thigh") > MOST
            assert deviation(poses, "thigh") > deviation(healthy, "thigh")
            await happens(listener, simulator, "plug S2", "S2", "ok")

            took_s, poses = await happens(listener, simulator, "stick S3", "S3", "stuck")
            assert took_s < FAULT_S
            assert share(poses, "stuck:S3") > MOST
            assert deviation(poses, "shank") > deviation(healthy, "shank")
            _, poses = await happens(listener, simulator, "free S3", "S3", "ok")
            assert any(sensors_in(pose) == {"S1", "S2", "S3", "S4"} for pose in poses)

            took_s, poses = await happens(
                listener, simulator, "slip S4 20", "shank", "pair_disagrees"
            )
            assert took_s < SLIP_S
            assert share(poses, "pair_disagrees:shank") > MOST
            assert deviation(poses, "shank") > deviation(healthy, "shank")
            _, poses = await happens(listener, simulator, "slip S4 -20", "shank", "agrees")
            assert len(knee_angles(poses)) > MOST * len(poses)
            assert longest_pause_s(listener.poses) < PAUSE_S
    assert "Traceback" not in station.log
