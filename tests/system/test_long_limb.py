"""Live chain of three segments with six sensors: calibration, tracking, re-donning."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.tools.demo._truth import TruthReader
from jointfit_simulators.body import SimulatedSubject, parse_motion_script
from jointfit_simulators.scene import RigOptions, Scene, SceneOptions
from jointfit_simulators.settings import Knobs, apply_settings, perfect
from tests.system.station import BASE, Station, in_this_process, listening, sensors_in

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from tests.broker_fixture import Broker
    from tests.system.station import Listener

pytestmark = [pytest.mark.system, pytest.mark.experiment]

SENSORS = {
    "S1": "thigh", "S2": "thigh", "S5": "thigh", "S3": "shank", "S4": "shank", "S6": "foot",
}  # fmt: skip
WIRES = {"S1": "xbus", "S2": "xcdi", "S3": "xbus", "S4": "xcdi", "S5": "xcdi", "S6": "xbus"}
SETTINGS = (
    "mount_deg=20", "soft_tissue_common_deg=3", "soft_tissue_sensor_deg=2", "occlusion=0",
    "transition_s=0.5", "seed=5",
)  # fmt: skip
SETTLE_S = 0.7
FUNCTIONAL_S = 14.0
"""Time in which the simulated movement takes every joint through its range."""
CHAIN = (
    ('joints = ["hip", "knee", "ankle"]', 'joints = ["hip", "knee", "ankle", "toe"]'),
    ('segments = ["thigh", "shank"]', 'segments = ["thigh", "shank", "foot"]'),
    ('distal = "foot"', "lengths_m = { foot = 0.15 }"),
)


@contextlib.asynccontextmanager
async def playing(folder: Path, port: int) -> AsyncIterator[Scene]:
    knobs = apply_settings(perfect(Knobs()), SETTINGS)
    rig = RigOptions(mqtt_port=port, mqtt_base=BASE, axes="static")  # axes of the log
    options = SceneOptions(folder, wires=WIRES, rig=rig)
    subject = SimulatedSubject(knobs, parse_motion_script("stand"), sensors=SENSORS)
    scene = Scene(knobs, subject, options, now_ns=time.monotonic_ns())
    async with in_this_process(scene):
        yield scene


async def record_phase(scene: Scene, listener: Listener, motion: str, *phase: Any) -> Any:
    scene.command(f"play {motion}")
    await asyncio.sleep(SETTLE_S)
    return await listener.phase(*phase, force=True)


async def errors_deg(scene: Scene, listener: Listener, folder: Path) -> dict[str, float]:
    """Return the RMS error of each segment over a second of squats."""
    scene.command("play squat")
    await asyncio.sleep(SETTLE_S)
    poses = await listener.more_poses(120)
    await asyncio.sleep(0.3)
    truth = TruthReader(folder / "truth.jsonl")
    truth.read()
    truth.close()
    offset_ns = time.time_ns() - time.monotonic_ns()
    off: dict[str, list[float]] = {"thigh": [], "shank": [], "foot": []}
    for pose in poses:
        known = truth.track.at(pose["t_us"] * 1000 - offset_ns)
        for name, angles in off.items():
            q = pose["segments"][name]["q"]
            if known is not None and q is not None:
                angles.append(float(rotation.angle_between(q, known.orientations[name])))
    assert min(map(len, off.values())) > 60
    return {n: math.degrees(np.sqrt(np.mean(np.square(angles)))) for n, angles in off.items()}


@pytest.mark.timeout(300)
async def test_chain_of_three_segments_with_six_sensors_is_calibrated_tracked_and_redonned(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port)
    async with playing(tmp_path, broker.port) as scene:
        station.write_rig(*CHAIN)
        async with station.daemon(), listening(station.port) as listener:
            await listener.connected({*SENSORS, "mocap"})
            await record_phase(scene, listener, "stand", "static", 2.0)
            status = await record_phase(scene, listener, "functional", "functional", FUNCTIONAL_S)
            assert status["phase"] == "calibrated", status
            donned = await errors_deg(scene, listener, tmp_path)
            complete = [pose for pose in listener.poses[-100:] if sensors_in(pose) == {*SENSORS}]
            assert len(complete) > 10  # on a busy machine samples are late
            for joint in ("knee", "ankle"):
                assert complete[-1]["joints"][joint]["flexion_deg"] is not None
                assert complete[-1]["joints"][joint]["flexion_deg_s"] is not None
            for name in SENSORS:
                scene.command(f"slip {name} 15")
            slipped = await errors_deg(scene, listener, tmp_path)
            status = await record_phase(scene, listener, "stand", "static", 2.0)
            assert status["phase"] == "posed", status
            redonned = await errors_deg(scene, listener, tmp_path)
            assert not [flag for flag in listener.poses[-1]["flags"] if "disagree" in flag]
    for name in ("thigh", "shank", "foot"):
        assert donned[name] < 5.0, donned
        assert slipped[name] > donned[name] + 5.0, slipped
        assert redonned[name] < donned[name] + 1.5, redonned
    assert "Traceback" not in station.log
