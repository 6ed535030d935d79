"""Sensor worlds that point elsewhere, hidden markers and NaN: the calibration copes, or says so."""

from __future__ import annotations

import asyncio
import itertools
import math
import time
from typing import TYPE_CHECKING, Any

import orjson
import pytest

from jointfit_daemon.tools.demo_score import Score
from jointfit_daemon.tools.demo_truth import TruthReader
from tests.system.station import Station, running

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.tools.demo_processes import Simulator
    from tests.broker_fixture import MosquittoBroker
    from tests.system.station import Listener

pytestmark = pytest.mark.system

SETTLE_S = 1.7
OPTIONS = (
    "--perfect", "--set", "heading_spread_deg=90", "--set", "optical_heading_deg=180",
    "--set", "mount_deg=20", "--set", "occlusion=0.1", "--seed", "3",
)  # fmt: skip
ASSUMED = "headings_from_static"


async def taken(simulator: Simulator, listener: Listener, motion: str, *phase: Any) -> Any:
    await simulator.say(f"play {motion}")
    await asyncio.sleep(SETTLE_S)
    return await listener.phase(*phase, force=True)


async def functional(simulator: Simulator, listener: Listener) -> Any:
    """Move, with all markers hidden for a second in the middle."""
    hiding = asyncio.create_task(hidden(simulator, 4.0), name="hiding")
    try:
        return await taken(simulator, listener, "functional", "functional", 10.0)
    finally:
        await hiding


async def hidden(simulator: Simulator, after_s: float) -> None:
    await asyncio.sleep(after_s)
    await simulator.say("occlude on")
    await asyncio.sleep(1.0)
    await simulator.say("occlude off")


async def knee_error_deg(listener: Listener, folder: Path) -> float:
    """Return the RMS error of knee flexion over the next two seconds."""
    poses = await listener.more_poses(200)
    await asyncio.sleep(0.3)
    score, truth = Score(), TruthReader(folder / "truth.jsonl")
    truth.read()
    truth.close()
    offset_ns = time.time_ns() - time.monotonic_ns()
    for pose in poses:
        if (known := truth.track.at(pose["t_us"] * 1000 - offset_ns)) is not None:
            score.add(pose, known, "knee")
    assert score.flexion.n > 150
    assert score.flexion.rms is not None
    return score.flexion.rms


@pytest.mark.timeout(120)
async def test_worlds_a_right_angle_apart_are_aligned_or_the_assumption_is_said(
    tmp_path: Path, mosquitto: MosquittoBroker
) -> None:
    station = Station(tmp_path, mosquitto.port, options=OPTIONS)
    async with running(station) as (simulator, _, listener):
        facts = orjson.loads((tmp_path / "truth.jsonl").read_bytes().split(b"\n", 1)[0])
        headings = list(facts["sensor_heading_rad"].values())
        apart = max(abs(a - b) for a, b in itertools.combinations(headings, 2))
        assert apart > math.radians(45), apart  # the seed does what the test is about
        await taken(simulator, listener, "stand", "static", 3.0)
        await functional(simulator, listener)
        pose = (await listener.more_poses(1))[0]
        assert ASSUMED in pose["flags"]
        await taken(simulator, listener, "plate", "align", 8.0)
        await taken(simulator, listener, "stand", "static", 3.0)
        await functional(simulator, listener)
        pose = (await listener.more_poses(1))[0]
        assert ASSUMED not in pose["flags"]
        await simulator.say("play squat")
        await asyncio.sleep(SETTLE_S)
        assert await knee_error_deg(listener, tmp_path) < 2.0
    assert "the worker said" not in station.log  # fits print nothing
    assert "Traceback" not in station.log
