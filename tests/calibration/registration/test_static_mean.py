"""Static mean of simulated orientations with outliers, and the acceptance of a static pose."""

from __future__ import annotations

import numpy as np
import pytest

from jointfit_daemon.calibration import (
    CalibrationError,
    CalibrationSettings,
    CalibrationTrial,
    SensorTrack,
)
from jointfit_daemon.calibration.phases import fit_static
from jointfit_daemon.calibration.registration import (
    RobustMean,
    StaticLimits,
    redonning_notes,
    robust_mean,
    static_mount,
    static_problems,
)
from jointfit_daemon.kinematics import rotation as rot
from jointfit_daemon.model import Chain

DEG = np.deg2rad(1.0)


def still(spread: float) -> RobustMean:
    return RobustMean(np.asarray(rot.IDENTITY), spread)


def test_outliers_change_a_robust_mean_less_than_a_plain_mean() -> None:
    rng = np.random.default_rng(0)
    truth = rot.exp([0.3, -1.2, 0.4])
    q = rot.multiply(truth, rot.exp(DEG * rng.normal(size=(500, 3))))
    q[::5] = rot.multiply(q[::5], rot.exp([0.8, 0.5, 0.0]))
    robust = robust_mean(q * rng.choice([-1.0, 1.0], 500)[:, None])
    # All outliers have the same rotation. For weights above zero this is the worst case.
    assert rot.angle_between(robust.q, truth) < 1.2 * DEG
    assert rot.angle_between(rot.average(q), truth) > 5 * DEG
    assert robust.spread < 3 * DEG


def test_frames_that_are_unknown_are_left_out() -> None:
    q = np.tile(rot.exp([0.1, 0.2, 0.3]), (10, 1))
    q[3] = np.nan
    assert rot.angle_between(robust_mean(q).q, q[0]) < 1e-12
    with pytest.raises(ValueError, match="no rotations"):
        robust_mean(np.full((5, 4), np.nan))


def test_the_mount_converts_sensor_to_segment_orientations() -> None:
    rng = np.random.default_rng(1)
    q_segment = rot.exp(rng.normal(0, 0.02, (300, 3)))
    mount = rot.exp([0.2, 0.9, -0.4])
    q_sensor = rot.multiply(q_segment, rot.conjugate(mount))
    assert rot.angle_between(static_mount(q_sensor, q_segment).q, mount) < 1e-9
    assert np.allclose(rot.multiply(q_sensor, static_mount(q_sensor, q_segment).q), q_segment)


def test_a_robust_mean_uses_the_given_weights() -> None:
    q = np.stack([rot.IDENTITY, rot.heading(0.002)])
    assert float(rot.heading_of(robust_mean(q, [3.0, 1.0]).q)) == pytest.approx(0.0005, rel=0.01)


def test_rejected_static_pose_is_reported_with_a_remedy() -> None:
    good = {"S1": still(0.2 * DEG), "S2": still(0.9 * DEG)}
    assert static_problems(good, 5.0) == ()
    (short,) = static_problems(good, 2.0)
    assert "2.0 s" in short
    assert "longer" in short
    slack = {**good, "S2": still(1.4 * DEG)}
    (loose,) = static_problems(slack, 5.0, StaticLimits(spread=DEG))
    assert loose.startswith("S2")
    assert "1.4 deg" in loose
    assert static_problems(slack, 5.0, StaticLimits(spread=2 * DEG)) == ()


def test_slipped_sensor_is_distinguished_from_a_changed_pose() -> None:
    before = {"S1": rot.exp([0.1, 0.2, 0.3]), "S2": rot.exp([-0.4, 0.0, 1.0])}
    segments = {"thigh": ("S1", "S2", "S9")}
    stooped = rot.exp([0.2, 0.0, 0.0])
    posture = {sensor: rot.multiply(q, stooped) for sensor, q in before.items()}
    assert redonning_notes(before, posture, segments) == ()
    slipped = {**posture, "S2": rot.multiply(posture["S2"], rot.exp([0.0, 0.0, 4 * DEG]))}
    (problem,) = redonning_notes(before, slipped, segments)
    assert "S1 and S2 differ by 4.0 deg" in problem


def test_a_pose_held_for_three_seconds_is_three_seconds_though_its_samples_span_less() -> None:
    t_ns = np.arange(299, dtype=np.int64) * 10_000_000
    track = SensorTrack(t_ns, np.tile(rot.IDENTITY, (len(t_ns), 1)))
    chain = Chain(("hip", "knee"), ("thigh",), (("S1",),))
    settings = CalibrationSettings(static_s=5.0)
    assert fit_static(CalibrationTrial({"S1": track}, None), settings, chain).still_s < 3.0
    half = SensorTrack(t_ns[:150], track.q_world_sensor[:150])
    with pytest.raises(CalibrationError, match="stand still for longer"):
        fit_static(CalibrationTrial({"S1": half}, None), settings, chain)
