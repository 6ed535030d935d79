"""Recorded subjects replay their trial unaltered, with an upright static pose."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.files.orientations import read_orientations_npz
from jointfit_simulators.body import (
    SENSORS,
    RecordedSubject,
    Step,
    UnknownMotionError,
    parse_motion_script,
    read_recorded_trial,
)
from jointfit_simulators.body._recorded_trial import InterpolatedTrack
from jointfit_simulators.devices import Cameras
from jointfit_simulators.scene._truth_log import TruthLog
from jointfit_simulators.settings import Knobs, perfect

if TYPE_CHECKING:
    from pathlib import Path

NONE = np.empty(0)


@pytest.fixture
def squats(shared_data: Path) -> list[Path]:
    semireal = shared_data / "semireal_knee4imu"
    opencap = shared_data / "opencap_subject4/trc/squats1.trc"
    return [semireal / "squats1.npz", semireal / "static_bias.json", opencap]


def test_recorded_subject_reproduces_sensors_bones_and_markers_of_the_files(
    squats: list[Path],
) -> None:
    recorded = read_orientations_npz(squats[0])
    subject = RecordedSubject(
        read_recorded_trial(squats), SENSORS, [Step("trial", 1.0)], transition_s=1.5
    )
    t = recorded.t_s - recorded.t_s[0] + 1.5  # the trial starts after the blend
    found = subject.observe([t] * 4, t, t)
    for name, q in zip(SENSORS, found.sensors, strict=True):
        measured = Rotation.from_quat(q, scalar_first=True)
        expected = Rotation.from_quat(recorded.sensors[name], scalar_first=True)
        assert np.degrees((measured.inv() * expected).magnitude()).max() < 1e-4
    knee = np.degrees(found.truth.angles[:, 0])
    assert (knee.min(), knee.max()) == pytest.approx((7.3, 104.5), abs=0.06)
    np.testing.assert_allclose(found.truth.joints["knee"], recorded.origins["tibia_r"], atol=1e-6)
    assert np.all(np.isnan(found.truth.joints["ankle"]))
    thigh = found.bones["thigh"][0].inv() * found.truth.orientations["thigh"]
    assert thigh.magnitude().max() < 1e-9
    assert found.markers.shape == (len(t), 51, 3)
    lateral_knee = [*sum(subject.clusters.values(), ())].index("r_knee")
    with np.load(squats[0]) as arrays:
        there = arrays["m_r_knee"][:, [2, 0, 1]]
    apart = np.linalg.norm(found.markers[:, lateral_knee] - there, axis=1)
    assert np.median(apart) < 0.002


def test_recording_is_interpolated_between_samples(squats: list[Path]) -> None:
    recorded = read_orientations_npz(squats[0])
    track = InterpolatedTrack(recorded.t_s, recorded.sensors["S3"], rotation=True)
    middle = (recorded.t_s[:-1] + recorded.t_s[1:]) / 2
    measured = Rotation.from_quat(track.at(middle), scalar_first=True)
    expected = Rotation.from_quat(recorded.sensors["S3"], scalar_first=True)
    halfway = expected[:-1] * Rotation.from_rotvec(
        (expected[:-1].inv() * expected[1:]).as_rotvec() / 2
    )
    assert np.degrees((measured.inv() * halfway).magnitude()).max() < 1e-3


def test_static_pose_with_known_biases_is_upright(squats: list[Path]) -> None:
    subject = RecordedSubject(
        read_recorded_trial(squats), SENSORS, parse_motion_script("stand:9,trial")
    )
    t = np.arange(0.0, 5.0, 0.1)
    found = subject.observe([t] * 4, t, t)
    assert found.truth.orientations["thigh"].magnitude().max() < 1e-9
    bias = json.loads(squats[1].read_text())["q_bias"]["S1"]
    q_bias = Rotation.from_quat(np.array(bias)[[0, 3, 1, 2]], scalar_first=True)
    measured = Rotation.from_quat(found.sensors[0], scalar_first=True)
    assert (measured * q_bias).magnitude().max() < 1e-9  # q_sensor q_bias = q_segment = 1


def test_orientations_are_continuous_between_standing_and_trial(squats: list[Path]) -> None:
    subject = RecordedSubject(
        read_recorded_trial(squats), SENSORS, parse_motion_script("stand:2,trial:12,stand")
    )
    t = np.arange(0.0, 18.0, 0.005)
    found = subject.observe([t] * 4, t, t)
    for q in found.sensors:
        measured = Rotation.from_quat(q, scalar_first=True)
        assert np.degrees((measured[:-1].inv() * measured[1:]).magnitude()).max() < 2.5
    assert [subject.motion_at(x) for x in (1.0, 3.0, 15.0)] == ["stand", "trial", "stand"]


def test_missing_recorded_samples_are_not_interpolated(shared_data: Path) -> None:
    walking = shared_data / "semireal_knee4imu/walking1.npz"
    recorded = read_orientations_npz(walking)
    subject = RecordedSubject(
        read_recorded_trial([walking]), SENSORS, [Step("trial", 1.0)], transition_s=1.0
    )
    t = recorded.t_s - recorded.t_s[0] + 1.0
    found = subject.observe([t] * 4, NONE, NONE)
    missing = [int(np.isnan(q[:, 0]).sum()) for q in found.sensors]
    assert missing[0] == missing[2] == missing[3] == 0
    assert 3 <= missing[1] <= 6  # rounding may extend a gap to the adjacent samples


def test_reference_bones_are_streamed_as_bodies(squats: list[Path]) -> None:
    subject = RecordedSubject(read_recorded_trial(squats), SENSORS, [Step("trial", 1.0)])
    cameras = Cameras(perfect(Knobs()), subject, rate_hz=100.0)
    t = np.arange(2.0, 8.0, 0.1)
    observation = subject.observe([NONE] * 4, t, t)
    frames = cameras.capture(observation)
    assert cameras.bodies == ("Thigh", "Shank")
    body = Rotation.from_quat(frames.body_orientations[:, 1], scalar_first=True)
    apart = body.inv() * observation.truth.orientations["shank"]
    assert apart.magnitude().max() < 1e-9


def test_incomplete_or_unknown_trial_files_are_rejected(tmp_path: Path, squats: list[Path]) -> None:
    with pytest.raises(ValueError, match="got 0"):
        read_recorded_trial(squats[1:])
    with pytest.raises(ValueError, match=r"'\.txt'"):
        read_recorded_trial([tmp_path / "a.txt"])
    with pytest.raises(UnknownMotionError, match="a trial has: stand, trial, trial@FROM-TO"):
        RecordedSubject(read_recorded_trial(squats), SENSORS, [Step("walk", 1.0)])


def test_truth_log_contains_past_instants_only_and_null_for_unknown_values(
    tmp_path: Path, squats: list[Path]
) -> None:
    subject = RecordedSubject(read_recorded_trial(squats), SENSORS, [Step("trial", 1.0)])
    t_ns = np.arange(0, 10**9, 10**7)
    truth = subject.observe([NONE] * 4, NONE, t_ns / 1e9).truth
    log = TruthLog(tmp_path / "truth.jsonl", {"lengths_m": {}})
    log.add(t_ns, ["trial"] * len(t_ns), truth, Rotation.identity())
    log.advance(500_000_000)
    first, *rows = map(json.loads, (tmp_path / "truth.jsonl").read_text().splitlines())
    log.close()
    assert first == {"truth": 1, "lengths_m": {}}
    assert [row["t_ns"] for row in rows] == list(range(0, 500_000_001, 10**7))
    assert rows[0]["joint_m"]["ankle"] == [None, None, None]
    assert set(rows[0]["q_world_segment"]) == {"thigh", "shank"}
    assert set(rows[0]["knee"]) == {"flexion", "adduction", "rotation"}
    assert rows[0]["included"] == pytest.approx(np.pi - abs(rows[0]["knee"]["flexion"]), abs=0.05)


def test_part_of_a_trial_is_played_at_its_time(squats: list[Path]) -> None:
    recorded = read_orientations_npz(squats[0])
    steps = parse_motion_script("stand:2,trial@8.06-9:9")
    subject = RecordedSubject(read_recorded_trial(squats), SENSORS, steps, transition_s=1.0)
    t = 3.0 + np.arange(0.0, 0.95, 0.02)  # the blend ends at 3 s
    found = subject.observe([t] * 4, t, t)
    first = round(8.06 * 50)
    expected = Rotation.from_quat(recorded.sensors["S2"][first : first + len(t)], scalar_first=True)
    measured = Rotation.from_quat(found.sensors[1], scalar_first=True)
    assert np.degrees((measured.inv() * expected).magnitude()).max() < 1e-4
    with pytest.raises(UnknownMotionError, match=r"13\.44 s long"):
        subject.play("trial@13.5-", 20.0)


def test_cameras_see_no_bones_during_synthetic_intervals(squats: list[Path]) -> None:
    steps = parse_motion_script("stand:2,trial@0-4:8,stand")
    subject = RecordedSubject(read_recorded_trial(squats), SENSORS, steps, transition_s=1.0)
    cameras = Cameras(perfect(Knobs()), subject, rate_hz=100.0)
    t = np.array([1.0, 1.99, 2.01, 2.5, 2.99, 3.0, 5.0, 7.0, 7.01, 9.9, 10.5, 11.01])
    frames = cameras.capture(subject.observe([NONE] * 4, t, t)).body_positions[:, :, 0]
    visible = [True, True, False, False, False, True, True, True, False, False, False, True]
    assert np.isfinite(frames).all(axis=1).tolist() == visible


def test_standing_shank_is_attached_to_the_thigh_as_in_the_trial(
    squats: list[Path],
) -> None:
    recorded = read_orientations_npz(squats[0])
    subject = RecordedSubject(read_recorded_trial(squats), SENSORS, parse_motion_script("stand"))
    t = np.array([1.0])
    found = subject.observe([NONE] * 4, t, t)
    (_, hip), (_, knee) = found.bones["thigh"], found.bones["shank"]
    femur = Rotation.from_quat(recorded.bones["femur_r"][0], scalar_first=True)
    offset = femur.inv().apply(recorded.origins["tibia_r"][0] - recorded.origins["femur_r"][0])
    np.testing.assert_allclose(knee - hip, offset[None], atol=1e-9)
