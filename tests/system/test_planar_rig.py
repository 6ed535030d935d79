"""A planar rig with cameras alone: joints and stick figure against the simulated bones."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.system.station import Listener, Station, running, stopped

if TYPE_CHECKING:
    from tests.broker_fixture import Broker

PAGE = Path(__file__).resolve().parents[2] / "docs" / "mqtt.md"
pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(200)]


async def test_joints_of_a_planar_movement_without_sensors(tmp_path: Path, broker: Broker) -> None:
    station = Station(tmp_path, broker.port, ("--planar",))
    async with running(station) as (simulator, daemon, listener):
        assert listener.client is not None
        await listener.client.subscribe("optical/sticks")
        await wait_for_small_errors(listener)
        figures = [await next_figure(listener) for _ in range(60)]  # longer than an occlusion

        await simulator.send_command("hide T4")
        await listener.until(lambda: only_the_hip_lacks(listener, "thigh: T4 not visible"))
        await simulator.send_command("show T4")
        await listener.until(lambda: joints(listener)["hip"]["p_m"] is not None)

        answer = await listener.client.request("calibrate", {"phase": "static"})
        assert "needs no calibration" in answer["error"]["message"]
        poses = await listener.more_poses(5)
        assert poses[-1]["segments"]["thigh"]["q"] is None
        code, _ = await stopped(daemon)
        assert code == 0, station.log

    compare_with_the_bones(figures, tmp_path / "truth.jsonl")
    (example,) = [
        body
        for body in re.findall(r"```json\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
        if '"sticks"' in body
    ]
    assert keys_of(figures[-1]) == keys_of(json.loads(example))


async def next_figure(listener: Listener) -> dict[str, Any]:
    before_us = listener.latest["optical/sticks"]["t_us"]
    await listener.until(lambda: listener.latest["optical/sticks"]["t_us"] > before_us)
    found: dict[str, Any] = listener.latest["optical/sticks"]
    return found


def only_the_hip_lacks(listener: Listener, reason: str) -> bool:
    """Return whether the hip has no position for this reason, and the knee has a position."""
    hip, knee = joints(listener)["hip"], joints(listener)["knee"]
    return hip["refused"] == reason and hip["p_m"] is None and knee["p_m"] is not None


def joints(listener: Listener) -> dict[str, Any]:
    found: dict[str, Any] = listener.latest["optical/sticks"]["joints"]
    return found


async def wait_for_small_errors(listener: Listener) -> None:
    def small() -> bool:
        if "optical/sticks" not in listener.latest:
            return False
        errors = [joint["error_m"] for joint in joints(listener).values()]
        return all(error is not None and error < 0.01 for error in errors)

    await listener.until(small, within_s=90.0)


def keys_of(value: Any) -> set[str]:
    """Return all keys of a payload."""
    if isinstance(value, list):
        return set().union(*map(keys_of, value))
    return {*value, *keys_of(list(value.values()))} if isinstance(value, dict) else set()


def compare_with_the_bones(figures: list[dict[str, Any]], path: Path) -> None:
    """Compare the lengths of the sticks in the plane with those of the bones."""
    with path.open() as lines:
        bones_m = json.loads(lines.readline())["lengths_m"]
    for segment, length_m in bones_m.items():
        found = []
        for figure in figures:
            ends = figure["sticks"][segment]["ends_m"]
            if None not in ends:
                normal, along = np.array(figure["plane"]["normal"]), np.subtract(*ends)
                found.append(np.linalg.norm(along - normal * (along @ normal)))
        assert len(found) > 0.5 * len(figures)
        assert np.median(found) == pytest.approx(length_m, abs=0.01)
    assert all(figure["plane"]["off_plane_m"] < 0.01 for figure in figures)
