"""Sensor faults during a movement: reported in time, excluded from poses, reported as ended."""

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
from tests.system.station import (
    SENSORS,
    Listener,
    Station,
    knee_angles,
    listening,
    load_factor,
    sensors_in,
)

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.tools.child_processes import Simulator
    from tests.broker_fixture import Broker

pytestmark = pytest.mark.system

SECOND_US = 1_000_000
BLOCK_S = 0.2
"""Interval of the simulator: a fault begins with its next block of samples, s."""
FAULT_S, SLIP_S = 0.5 + BLOCK_S, 2.0 + BLOCK_S
"""Limits from the command to the event of a failed sensor and of a sensor slip, s."""
POSE_GAP_S = 0.5
"""Longest interval between two poses, s."""
FLAGGED = 0.8
"""Smallest share of poses with the flag of a fault; a loaded machine may spoil single poses."""
FAULT_FLAG = re.compile("stuck|slipped|pair_disagrees|heading_disagrees")


async def wait_for_state(
    listener: Listener, simulator: Simulator, command: str, name: str, state: str
) -> tuple[float, list[dict[str, Any]]]:
    """Send a command to the simulator and wait for the event of a sensor's state.

    Returns
    -------
    Time from the command to the event, s, and 50 poses of instants after the event.
    """
    began_us = time.time_ns() // 1000

    def matching() -> list[dict[str, Any]]:
        return [
            event
            for event in listener.events
            if (event["kind"], event["id"], event["data"].get("state")) == ("sensor", name, state)
            and event["t_us"] >= began_us
        ]

    await simulator.send_command(command)
    await listener.until(matching)
    t_us = matching()[0]["t_us"]
    return (t_us - began_us) / SECOND_US, await listener.poses_after(t_us, 50)


def median_sd_deg(poses: list[dict[str, Any]], segment: str) -> float:
    """Return the median of the known standard deviations of a segment, deg."""
    found = [pose["segments"][segment]["sd_deg"] for pose in poses]
    return statistics.median(float(sd) for sd in found if sd is not None)


def share_with(poses: list[dict[str, Any]], flag: str) -> float:
    """Return the share of poses with a flag."""
    return sum(flag in pose["flags"] for pose in poses) / len(poses)


@pytest.mark.timeout(180)
async def test_failed_stuck_and_slipped_sensors_are_reported_and_excluded_until_they_work_again(
    tmp_path: Path, broker: Broker
) -> None:
    calibration = fitted(bench_rig())  # of the subject in the simulator
    options = ("--seed", "1", "--no-mocap", "--programme", "walk:600")
    station = Station(tmp_path, broker.port, options=options)
    async with station.simulator() as simulator:
        store = load_rig(station.rig).calibration_store
        CalibrationStore(tmp_path / "state" / "calibrations", store).save(calibration)
        async with station.daemon(), listening(broker.port) as listener:
            await listener.connected(SENSORS)
            await listener.until(lambda: listener.poses and listener.poses[-1]["sync"] == "locked")
            healthy = await listener.more_poses(150)
            flags = {flag for pose in healthy for flag in pose["flags"]}
            assert not {flag for flag in flags if FAULT_FLAG.match(flag)}

            took_s, poses = await wait_for_state(listener, simulator, "unplug S2", "S2", "lost")
            assert took_s < FAULT_S * load_factor()
            assert share_with(poses, "one_sensor:thigh") > FLAGGED
            assert median_sd_deg(poses, "thigh") > median_sd_deg(healthy, "thigh")
            await wait_for_state(listener, simulator, "plug S2", "S2", "ok")

            took_s, poses = await wait_for_state(listener, simulator, "stick S3", "S3", "stuck")
            assert took_s < FAULT_S * load_factor()
            assert share_with(poses, "stuck:S3") > FLAGGED
            assert median_sd_deg(poses, "shank") > median_sd_deg(healthy, "shank")
            _, poses = await wait_for_state(listener, simulator, "free S3", "S3", "ok")
            assert any(sensors_in(pose) == {*SENSORS} for pose in poses)

            took_s, poses = await wait_for_state(
                listener, simulator, "slip S4 20", "shank", "pair_disagrees"
            )
            assert took_s < SLIP_S * load_factor()
            assert share_with(poses, "pair_disagrees:shank") > FLAGGED
            assert median_sd_deg(poses, "shank") > median_sd_deg(healthy, "shank")
            _, poses = await wait_for_state(listener, simulator, "slip S4 -20", "shank", "agrees")
            assert len(knee_angles(poses)) > FLAGGED * len(poses)

            gaps_us = [b["t_us"] - a["t_us"] for a, b in pairwise(listener.poses)]
            assert max(gaps_us) / SECOND_US < POSE_GAP_S * load_factor()
    assert "Traceback" not in station.log
