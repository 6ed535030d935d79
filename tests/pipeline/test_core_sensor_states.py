"""Sensor states as an output of the core: rate, content, and pose by the steps of the patent."""

from __future__ import annotations

import random
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from jointfit_daemon.config import parse_rig
from jointfit_daemon.limb_model import (
    Calibration,
    JointCalibration,
    PatentModel,
    SegmentCalibration,
    SensorCalibration,
    model_key,
)
from jointfit_daemon.model import LimbState, SensorStates
from jointfit_daemon.pipeline.events import ChunkArrived, Configured, Event, SourceOpened
from tests.pipeline.core_feed import BEGIN_NS, SENSORS, Bench, arrival_ns, chunk, table

GROUPS = (("S1", "S2"), ("S3", "S4"))
COUNT = 250
SAME_DEG = 0.01


def quaternion(rng: np.random.Generator) -> tuple[float, float, float, float]:
    w, x, y, z = Rotation.random(random_state=rng).as_quat(scalar_first=True).tolist()
    return (w, x, y, z)


@cache
def calibration() -> Calibration:
    """Return a calibration of the patent with arbitrary alignments and coefficients."""
    rng = np.random.default_rng(4)
    segments = {}
    for name, group in zip(("thigh", "shank"), GROUPS, strict=True):
        rows = rng.normal([0.6, 0.6, 0.0], 0.1, (4, 3)).tolist()
        model = PatentModel("patent12", tuple(map(tuple, rows)), (1.0, 0.0, 0.0, 0.0), 0.02, 3)
        segments[name] = SegmentCalibration(
            (1.0, 0.0, 0.0, 0.0), 0.4, 0.01, {model_key(group, None): model}
        )
    return Calibration(
        method="patent12",
        joints=("hip", "knee", "ankle"),
        segments=("thigh", "shank"),
        chain_sensors=GROUPS,
        sensor={name: SensorCalibration(quaternion(rng), quaternion(rng)) for name in SENSORS},
        segment=segments,
        joint=dict.fromkeys(("hip", "knee", "ankle"), JointCalibration(None, None, "unknown")),
        procedure="patent",
    )


@cache
def outputs(sensors_hz: float, *, calibrated: bool = True) -> tuple[LimbState | SensorStates, ...]:
    """Return the outputs of the core for the bytes of all sensors; some samples are missing."""
    dice = random.Random(7)
    rig = parse_rig(table() | {"mqtt": {"sensors_hz": sensors_hz}})
    used = calibration() if calibrated else None
    opening: list[Event] = [Configured(BEGIN_NS, rig, used)]
    opening += [SourceOpened(BEGIN_NS, name) for name in SENSORS]
    samples: list[ChunkArrived] = [
        chunk(name, k) for name in SENSORS for k in range(COUNT) if dice.random() > 0.02
    ]
    bench = Bench()
    bench.feed(opening + sorted(samples, key=arrival_ns))
    return tuple(one for one in bench.out if isinstance(one, LimbState | SensorStates))


def rotation(q: object) -> Rotation:
    return Rotation.from_quat(np.array(q), scalar_first=True)


def paired() -> list[tuple[LimbState, SensorStates]]:
    states = {one.seq: one for one in outputs(1000.0) if isinstance(one, LimbState)}
    found = [one for one in outputs(1000.0) if isinstance(one, SensorStates)]
    return [(states[one.seq], one) for one in found]


def test_sensors_are_an_output_only_if_configured_and_at_most_at_their_rate() -> None:
    assert not [one for one in outputs(0.0) if isinstance(one, SensorStates)]
    stamps = [one.t_ns for one in outputs(20.0) if isinstance(one, SensorStates)]
    assert set(np.diff(stamps).tolist()) == {50_000_000}
    frames = [one for one in outputs(1000.0) if isinstance(one, LimbState)]
    assert len(paired()) == len(frames) > 200


def test_segment_of_a_sensor_is_its_orientation_between_its_world_and_its_alignment() -> None:
    known = 0
    for _, frame in paired():
        for sensor in frame.sensors:
            if sensor.q_world_sensor is None:
                assert sensor.q_world_segment is None
                continue
            used = calibration().sensor[sensor.name]
            expected = (
                rotation(used.q_optical_world)
                * rotation(sensor.q_world_sensor)
                * rotation(used.q_sensor_segment)
            )
            assert (expected.inv() * rotation(sensor.q_world_segment)).magnitude() < 1e-9
            known += 1
    assert known > 800


def test_pose_of_the_daemon_is_the_regression_of_these_orientations() -> None:
    compared = 0
    for state, frame in paired():
        inputs = {sensor.name: sensor.q_world_segment for sensor in frame.sensors}
        for segment, group in zip(state.segments, GROUPS, strict=True):
            q = [inputs[name] for name in group]
            if None in q:
                assert segment.q_world_segment is None
                continue
            model = calibration().segment[segment.name].models[model_key(group, None)]
            assert isinstance(model, PatentModel)
            a = np.array(model.coefficients)
            same = [np.array(one) * (1.0 if one[0] >= 0.0 else -1.0) for one in q if one]
            expected = a[:, 0] * same[0] + a[:, 1] * same[1] + a[:, 2]
            if np.linalg.norm(expected) < 0.5:
                assert segment.q_world_segment is None
                continue
            apart = rotation(expected).inv() * rotation(segment.q_world_segment)
            assert np.degrees(apart.magnitude()) < SAME_DEG
            compared += 1
    assert compared > 100


def test_joint_rotation_is_the_distal_segment_seen_from_the_proximal_one() -> None:
    for state, frame in paired():
        above, below = (segment.q_world_segment for segment in state.segments)
        ((name, q_joint),) = frame.joints
        assert name == "knee"
        if above is None or below is None:
            assert q_joint is None
        else:
            expected = rotation(above).inv() * rotation(below)
            assert (expected.inv() * rotation(q_joint)).magnitude() < 1e-9


def test_without_a_calibration_the_sensors_have_their_own_orientation_only() -> None:
    found = [one for one in outputs(20.0, calibrated=False) if isinstance(one, SensorStates)]
    assert any(sensor.q_world_sensor for one in found for sensor in one.sensors)
    assert all(sensor.q_world_segment is None for one in found for sensor in one.sensors)
    assert all(q is None for one in found for _, q in one.joints)
