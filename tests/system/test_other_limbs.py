"""Simulated arm, trunk and both legs: calibration and live angles through the real daemon."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.tools.demo._truth import TruthReader
from jointfit_simulators.body import LIMBS, SimulatedSubject, parse_motion_script
from jointfit_simulators.scene import RigOptions, Scene, SceneOptions
from jointfit_simulators.settings import Knobs, apply_settings, perfect
from tests.system import station as gateway
from tests.system.station import (
    BASE,
    PATIENCE_S,
    TOPICS,
    Station,
    in_this_process,
    listening,
    load_factor,
    sensors_in,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from jointfit_daemon.tools.demo._score import TrueLimbState
    from tests.broker_fixture import Broker
    from tests.system.station import Listener

pytestmark = [pytest.mark.system, pytest.mark.experiment]

SETTINGS = (
    "mount_deg=20", "soft_tissue_common_deg=3", "soft_tissue_sensor_deg=2", "occlusion=0",
    "transition_s=0.5", "seed=5", "rate_hz=50", "mocap_hz=50",
)  # fmt: skip
SETTLE_S = 0.7
OUTPUT_HZ = 50.0
LIVE_FRAMES = 210
"""Number of frames of a live movement: one cycle of the slowest movement, abduction."""
Pairs = list[tuple[dict[str, Any], "TrueLimbState"]]


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait longer for a fit on a busy machine."""
    monkeypatch.setattr(gateway, "PATIENCE_S", PATIENCE_S * load_factor())


@contextlib.asynccontextmanager
async def playing(
    folder: Path,
    port: int,
    limb: str,
    sensors: dict[str, str] | None = None,
    rates: tuple[str, ...] = (),
) -> AsyncIterator[Scene]:
    knobs = apply_settings(perfect(Knobs()), (*SETTINGS, *rates))
    rig = RigOptions(
        output_rate_hz=OUTPUT_HZ,
        mqtt_port=port,
        mqtt_base=BASE,
        axes="static",  # the axes of the truth log
    )
    subject = SimulatedSubject(knobs, parse_motion_script("stand"), sensors=sensors, limb=limb)
    scene = Scene(knobs, subject, SceneOptions(folder, rig=rig), now_ns=time.monotonic_ns())
    async with in_this_process(scene):
        yield scene


async def calibrate(scene: Scene, listener: Listener, functional_s: float = 20.0) -> None:
    phases = (("stand", "static", 2.0), ("functional", "functional", functional_s))
    for motion, phase, seconds in phases:
        scene.command(f"play {motion}")
        await asyncio.sleep(SETTLE_S)
        status = await listener.phase(phase, seconds, force=True)
        assert status["phase"] == ("posed" if phase == "static" else "calibrated"), status


async def live(scene: Scene, listener: Listener, folder: Path, motion: str) -> Pairs:
    """Return the poses of one movement with the ground truth at their times."""
    scene.command(f"play {motion}")
    await asyncio.sleep(SETTLE_S)
    poses = await listener.more_poses(LIVE_FRAMES)
    offset_ns = time.time_ns() - time.monotonic_ns()
    last_ns = poses[-1]["t_us"] * 1000 - offset_ns
    truth = TruthReader(folder / "truth.jsonl")
    with contextlib.closing(truth):
        async with asyncio.timeout(30.0):
            while truth.track.at(last_ns) is None:  # the log follows within 0.2 s
                truth.read()
                await asyncio.sleep(0.05)
    pairs = [(pose, truth.track.at(pose["t_us"] * 1000 - offset_ns)) for pose in poses]
    known = [(pose, bones) for pose, bones in pairs if bones is not None]
    assert len(known) == LIVE_FRAMES
    return known


def between(bones: TrueLimbState, proximal: str, distal: str) -> Rotation:
    one, other = (
        Rotation.from_quat(bones.orientations[name], scalar_first=True)
        for name in (proximal, distal)
    )
    return one.inv() * other


def elevation_deg(bones: TrueLimbState) -> float:
    """Return the angle between the long axes of thorax and upper arm, in degrees."""
    down = np.array([0.0, 0.0, -1.0])
    raised = between(bones, "thorax", "upper_arm").apply(down)
    return math.degrees(math.acos(float(np.clip(raised @ down, -1.0, 1.0))))


def rms_deg(
    pairs: Pairs, joint: str, key: str, true_deg: Callable[[TrueLimbState], float]
) -> float:
    errors = [
        pose["joints"][joint][key] - true_deg(bones)
        for pose, bones in pairs
        if pose["joints"][joint][key] is not None
    ]
    assert len(errors) > 0.5 * len(pairs)  # on a busy machine samples are late
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.timeout(600)
async def test_an_arm_is_calibrated_and_abducted_through_90_degrees_without_lock(
    tmp_path: Path, broker: Broker
) -> None:
    """At 90 degrees, the shoulder angles have no gimbal lock."""
    station = Station(tmp_path, broker.port)
    async with playing(tmp_path, broker.port, "arm") as scene:
        station.write_rig()
        async with station.daemon(), listening(station.port) as listener:
            await listener.connected({*LIMBS["arm"].sensors, "mocap"})
            await listener.until(lambda: "bridge/info" in listener.latest)
            assert listener.latest["bridge/info"]["angles"] == {
                "shoulder": "elevation", "elbow": "flexion", "wrist": "flexion",
            }  # fmt: skip
            await calibrate(scene, listener)

            raised = await live(scene, listener, tmp_path, "abduction")
            bent = await live(scene, listener, tmp_path, "elbow_flexion")
            assert any(sensors_in(pose) == {*LIMBS["arm"].sensors} for pose, _ in raised)

    high = [(pose, bones) for pose, bones in raised if elevation_deg(bones) > 30.0]
    assert min(elevation_deg(bones) for _, bones in high) < 60.0
    assert max(elevation_deg(bones) for _, bones in high) > 110.0
    for pose, _ in high:
        assert "gimbal" not in pose["flags"]
        shoulder = pose["joints"]["shoulder"]
        assert {"plane_deg", "elevation_deg", "rotation_deg"} <= shoulder.keys()
        assert shoulder["sd_deg"] is not None
        assert 0.0 < shoulder["sd_deg"] < 20.0
    assert rms_deg(high, "shoulder", "elevation_deg", elevation_deg) < 5.0
    planes = np.unwrap(np.radians([pose["joints"]["shoulder"]["plane_deg"] for pose, _ in high]))
    assert np.degrees(np.abs(planes)).max() < 30.0  # abduction, slightly in front of the body
    elbow = rms_deg(bent, "elbow", "flexion_deg", lambda bones: math.degrees(bones.flexion))
    assert elbow < 5.0
    assert "Traceback" not in station.log


@pytest.mark.timeout(600)
async def test_a_trunk_is_calibrated_and_its_bend_and_twist_are_measured(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port)
    async with playing(tmp_path, broker.port, "trunk") as scene:
        station.write_rig()
        async with station.daemon(), listening(station.port) as listener:
            await listener.connected({*LIMBS["trunk"].sensors, "mocap"})
            await listener.until(lambda: "bridge/info" in listener.latest)
            assert listener.latest["bridge/info"]["angles"] == {"lumbar": "trunk"}
            await calibrate(scene, listener)

            bent = await live(scene, listener, tmp_path, "bend")
            twisted = await live(scene, listener, tmp_path, "twist")

    flexion = [bones.flexion for _, bones in bent]
    assert math.degrees(max(flexion)) > 50.0
    assert rms_deg(bent, "lumbar", "flexion_deg", lambda b: math.degrees(b.flexion)) < 5.0

    def rotation_deg(bones: TrueLimbState) -> float:
        return float(between(bones, "pelvis", "thorax").as_euler("XYZ", degrees=True)[2])

    assert max(abs(rotation_deg(bones)) for _, bones in twisted) > 20.0
    assert rms_deg(twisted, "lumbar", "rotation_deg", rotation_deg) < 5.0
    assert all("bending_deg" in pose["joints"]["lumbar"] for pose, _ in twisted)
    assert "Traceback" not in station.log


@pytest.mark.timeout(900)
async def test_both_legs_with_a_shared_pelvis_are_calibrated_and_walk_in_one_daemon(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port)
    sensors = {name: part for name, part in LIMBS["legs"].sensors.items() if int(name[1:]) % 2}
    rates = ("rate_hz=25", "mocap_hz=25")
    async with playing(tmp_path, broker.port, "legs", sensors, rates) as scene:
        station.write_rig()
        async with (
            station.daemon(),
            listening(station.port, topics=(*TOPICS, "optical/pose")) as listener,
        ):
            await listener.connected({*sensors, "mocap"})
            await listener.until(lambda: "bridge/info" in listener.latest)
            info = listener.latest["bridge/info"]
            assert info["side"] == "both"
            assert info["connections"]["left_hip"] == {
                "parent": "pelvis", "child": "left_thigh", "side": "left",
            }  # fmt: skip
            assert [*info["angles"]] == ["right_hip", "right_knee", "left_hip", "left_knee"]
            await calibrate(scene, listener, functional_s=32.0)

            squats = await live(scene, listener, tmp_path, "squat")

            # On a busy machine, single frames of the cameras have no pose to compare with.
            def has_residuals() -> bool:
                joints = listener.latest["optical/pose"]["joints"]
                hips = joints["right_hip"], joints["left_hip"]
                return all(hip["residual"] is not None for hip in hips)

            await listener.until(has_residuals)
            optical = listener.latest["optical/pose"]

    def flexion_deg(side: str, joint: str) -> Callable[[TrueLimbState], float]:
        parts = ("thigh", "shank") if joint == "knee" else ("pelvis", "thigh")
        proximal, distal = (p if p == "pelvis" else f"{side}_{p}" for p in parts)
        sign = -1.0 if joint == "knee" else 1.0
        return lambda bones: (
            sign * float(between(bones, proximal, distal).as_euler("XYZ", degrees=True)[0])
        )

    for side in ("right", "left"):
        for joint in ("hip", "knee"):
            true_deg = flexion_deg(side, joint)
            assert max(true_deg(bones) for _, bones in squats) > 40.0
            assert rms_deg(squats, f"{side}_{joint}", "flexion_deg", true_deg) < 5.0, (side, joint)
        assert optical["joints"][f"{side}_ankle"]["p_m"] is not None
        assert optical["joints"][f"{side}_hip"]["residual"] is not None
    pose, bones = squats[-1]
    for joint, center in bones.centers.items():
        assert math.dist(pose["joints"][joint]["p_m"], center) < 0.06, joint
    assert "Traceback" not in station.log
