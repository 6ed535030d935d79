"""The procedure of patent CN 114533039 B: exactly the steps S2 to S7.

The expected values are the equations of the patent, evaluated with NumPy and SciPy from the
orientations that the sensors measured.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.calibration.phases import fit_calibration, fit_static, with_new_static
from jointfit_daemon.fusion import LimbFuser
from jointfit_daemon.kinematics.joint_angles import read_patent
from jointfit_daemon.limb_model import Calibration
from jointfit_daemon.model import FrameFlag
from jointfit_daemon.tools.fuse._output import chain_of, fuse_trial
from jointfit_daemon.tools.fuse._tables import OrientationRecording
from tests.calibration.synthetic_limb import (
    CHAIN,
    OWNER,
    SETTINGS,
    Imperfections,
    Subject,
    motion,
    record,
    static_and_functional,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import PatentReading, Procedure
    from jointfit_daemon.model import LimbState, Quaternion

STATIC_CHAIN = replace(CHAIN, static_axes=True)
FLAWS = Imperfections(sensor_deg=0.3, tissue_deg=6.0, heading_deg=0.0)
SUBJECT = Subject(5, facing=0.0, flaws=FLAWS)
"""Subject who faces +y. Sensors and cameras have the same world. The patent assumes both facts."""
COUNT = 400
STEP_NS = 10_000_000
SAME_DEG = 0.01
Frames = dict[str, np.ndarray]


def calibration(
    reading: PatentReading = "patent12", procedure: Procedure = "patent"
) -> Calibration:
    return fitted(reading, procedure)


@cache
def fitted(reading: PatentReading, procedure: Procedure) -> Calibration:
    static, functional, _ = static_and_functional(SUBJECT, 20.0)
    chosen = replace(SETTINGS, method=reading, procedure=procedure)
    return fit_calibration(static, functional, None, chosen, STATIC_CHAIN)


@cache
def recorded() -> Frames:
    """Return q_world_sensor, shape (n, 4), by sensor, of a movement that no fit has used."""
    tracks = record(SUBJECT, motion(SUBJECT, 10.0, 400.0), 31, cameras=False).sensors
    return {name: track.q_world_sensor[:COUNT] for name, track in tracks.items()}


def drifting(frames: Frames) -> Frames:
    """Return the frames with a heading drift of S2 (1 deg/s), and a slip of S4 (25°, after 2 s)."""
    turn = Rotation.from_rotvec(np.radians(np.outer(np.arange(COUNT) * 0.01, [0.0, 0.0, 1.0])))
    slip = Rotation.from_rotvec(np.radians(np.outer(np.arange(COUNT) >= 200, [25.0, 0.0, 0.0])))
    return frames | {
        "S2": (turn * rotations(frames["S2"])).as_quat(scalar_first=True),
        "S4": (rotations(frames["S4"]) * slip).as_quat(scalar_first=True),
    }


def stuck(frames: Frames) -> Frames:
    """Return the frames with S1 stuck after two seconds."""
    rows = np.minimum(np.arange(COUNT), 200)
    return frames | {"S1": frames["S1"][rows]}


def play(fuser: LimbFuser, frames: Frames, *, lost: range = range(0)) -> list[LimbState]:
    """Fuse all frames; S3 has no data in the frames of `lost`."""
    rows: dict[str, list[Quaternion]] = {
        name: [(w, x, y, z) for w, x, y, z in q.tolist()] for name, q in frames.items()
    }
    states = []
    for k in range(COUNT):
        shown = {name: row[k] for name, row in rows.items() if name != "S3" or k not in lost}
        states.append(fuser.fuse(k * STEP_NS, k * STEP_NS, k, shown))
    return states


def rotations(q: Array) -> Rotation:
    return Rotation.from_quat(q, scalar_first=True)


@cache
def bias(sensor: str) -> Array:
    """Return q_bias of step S2, averaged over the static pose.

    q_bias satisfies q_s (x) q_bias = (1, 0, 0, 0), with the measured orientation q_s of the sensor.
    """
    tracks = record(SUBJECT, motion(SUBJECT, 6.0, 400.0, still=True), 1).sensors
    found = []
    for w, x, y, z in tracks[sensor].q_world_sensor:
        left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
        found.append(np.linalg.solve(left, [1.0, 0.0, 0.0, 0.0]))
    same_sign = np.array(found) * np.sign(np.array(found) @ found[0])[:, None]
    return np.asarray(same_sign.mean(axis=0))


def steps(used: Calibration, frames: Frames) -> list[Rotation]:
    """Return the orientations of thigh and shank in every frame by steps S3 and S4."""
    out = []
    for segment, sensors in zip(CHAIN.segments, CHAIN.sensors, strict=True):
        table = used.quality["regression"][segment]
        a = np.array(table["stored"])
        y = a[:, -1] + np.zeros((COUNT, 4))
        for k, sensor in enumerate(sensors):
            q = (rotations(frames[sensor]) * rotations(bias(sensor))).as_quat(scalar_first=True)
            sign = np.where(q @ table["q_sign"] < 0.0, -1.0, 1.0)
            y = y + a[:, k] * q * sign[:, None]
        out.append(rotations(y))
    return out


def apart_deg(states: list[LimbState], segment: int, expected: Rotation) -> Array:
    said = np.array([state.segments[segment].q_world_segment for state in states])
    return np.asarray(np.degrees((rotations(said).inv() * expected).magnitude()))


@pytest.mark.parametrize("reading", ["patent12", "patent6"])
@pytest.mark.parametrize("faulty", [dict, drifting, stuck])
def test_segments_are_the_regression_of_the_raw_sensors_also_with_faults(
    reading: PatentReading, faulty: Callable[[Frames], Frames]
) -> None:
    used, frames = calibration(reading), faulty(recorded())
    states = play(LimbFuser(STATIC_CHAIN, used), frames)
    for i, expected in enumerate(steps(used, frames)):
        assert apart_deg(states, i, expected).max() < SAME_DEG


def test_without_the_procedure_faults_change_the_inputs_of_the_regression() -> None:
    used, frames = calibration(procedure="corrected"), drifting(recorded())
    states = play(LimbFuser(STATIC_CHAIN, used), frames)
    assert max(apart_deg(states, i, q).max() for i, q in enumerate(steps(used, frames))) > 1.0


def test_positions_and_angles_follow_from_the_regression_by_steps_s5_to_s7() -> None:
    used = calibration()
    (thigh, shank), states = steps(used, recorded()), play(LimbFuser(CHAIN, used), recorded())
    lengths = [used.segment[name].length or 0.0 for name in CHAIN.segments]
    knee = thigh.apply([0.0, 0.0, -lengths[0]])
    ankle = knee + shank.apply([0.0, 0.0, -lengths[1]])
    for number, expected in ((1, knee), (2, ankle)):
        said = np.array([state.joints[number].position for state in states])
        assert np.abs(said - expected).max() < 1e-4

    gamma, beta, alpha = (thigh.inv() * shank).as_euler("ZYX").T
    for k, state in enumerate(states[::50]):
        above, below = (segment.q_world_segment for segment in state.segments)
        assert above is not None
        assert below is not None
        angles = read_patent(above, below)
        wanted = (alpha[50 * k], beta[50 * k], gamma[50 * k], np.pi - abs(alpha[50 * k]))
        assert angles[:4] == pytest.approx(wanted, abs=np.radians(SAME_DEG))


def test_fuse_apply_gives_the_same_orientations_for_the_stored_calibration() -> None:
    used = Calibration.from_dict(json.loads(json.dumps(calibration().to_dict())))
    frames = drifting(recorded())
    frames["S3"] = np.where(np.arange(COUNT)[:, None] == 50, np.nan, frames["S3"])
    trial = OrientationRecording(0.01 * np.arange(COUNT, dtype=np.float64), frames, {})
    found = fuse_trial(used, trial, chain_of(used, left=False))
    thigh, shank = steps_once(drift=True)
    rest = np.arange(COUNT) != 50
    for name, expected in (("thigh", thigh), ("shank", shank)):
        apart = rotations(found.segments[name][rest]).inv() * expected[rest]
        assert np.degrees(apart.magnitude()).max() < SAME_DEG
    assert np.isnan(found.segments["shank"][50]).all()
    assert found.flags["uncorrected"] == 1.0


def test_segment_is_lost_while_a_sensor_is_missing_and_exact_before_and_after() -> None:
    used, gap = calibration(), range(100, 130)
    states = play(LimbFuser(STATIC_CHAIN, used), recorded(), lost=gap)
    for k in gap:
        thigh, shank = states[k].segments
        assert thigh.used == ("S1", "S2")
        assert shank.q_world_segment is None
        assert "lost:shank" in states[k].flags
        assert states[k].joints[1].angles is None
        assert states[k].joints[2].position is None
    _, expected = steps(used, recorded())
    rest = [k for k in range(COUNT) if k not in gap]
    assert apart_deg([states[k] for k in rest], 1, expected[rest]).max() < SAME_DEG


def test_faults_are_reported_and_the_procedure_is_named_in_every_frame() -> None:
    fuser = LimbFuser(STATIC_CHAIN, calibration())
    states = play(fuser, stuck(drifting(recorded())))
    assert all(FrameFlag.UNCORRECTED in state.flags for state in states)
    assert "stuck:S1" in states[-1].flags
    assert states[-1].segments[0].used == ("S1", "S2")
    assert "pair_disagrees:shank" in states[-1].flags
    assert {report.state for report in fuser.pop_reports(COUNT * STEP_NS)} >= {"stuck"}
    assert fuser.consistency is not None
    assert "'doubtful': True" in str(fuser.consistency.health())

    corrected = LimbFuser(STATIC_CHAIN, calibration(procedure="corrected"))
    assert FrameFlag.UNCORRECTED not in play(corrected, recorded())[0].flags


def test_coefficients_in_force_are_the_verified_ones_for_all_sensors_only() -> None:
    used = calibration()
    for segment, group in zip(CHAIN.segments, CHAIN.sensors, strict=True):
        figures = used.quality["regression"][segment]
        assert figures["stored"] == figures["verified"]
        assert list(used.segment[segment].models) == ["+".join(group) + "|"]
    assert used.quality["holdout"]["procedure"] == "patent"
    assert "those of this fit" in used.quality["holdout"]["meaning"]
    assert used.quality.get("markers") is None
    refitted = calibration(procedure="corrected").quality["regression"]["thigh"]
    assert refitted["stored"] != refitted["verified"]


def test_new_static_pose_defines_the_segments_as_unrotated_again() -> None:
    used = calibration()
    turned = replace(SUBJECT, facing=0.1)  # the subject has another pose, which the patent ignores
    trial = record(turned, motion(turned, 6.0, 400.0, still=True), 9)
    pose = fit_static(trial, replace(SETTINGS, procedure="patent"), STATIC_CHAIN)
    again = with_new_static(used, pose)
    assert "same_pose_assumed" in again.flags
    for name, segment in OWNER.items():
        q_static = rotations(np.array(used.segment[segment].q_static))
        mean = trial.sensors[name].q_world_sensor
        mean = (mean * np.sign(mean @ mean[0])[:, None]).mean(axis=0)
        expected = rotations(mean).inv() * q_static
        said = rotations(np.array(again.sensor[name].q_sensor_segment))
        assert np.degrees((said.inv() * expected).magnitude()) < 1e-6


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_every_frame_depends_on_itself_alone(seed: int) -> None:
    order = np.random.default_rng(seed).permutation(COUNT)[:100]
    fuser = LimbFuser(STATIC_CHAIN, calibration())
    frames = recorded()
    expected = steps_once()
    for k in order.tolist():
        shown = {name: tuple(q[k].tolist()) for name, q in frames.items()}
        state = fuser.fuse(k * STEP_NS, k * STEP_NS, k, shown)
        for i, wanted in enumerate(expected):
            assert apart_deg([state], i, wanted[k]).max() < SAME_DEG


@cache
def steps_once(*, drift: bool = False) -> list[Rotation]:
    return steps(calibration(), drifting(recorded()) if drift else recorded())
