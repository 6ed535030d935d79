"""Joint positions: geometry by hand, and covariance against noise that was drawn."""

from __future__ import annotations

import numpy as np
import pytest

from jointfit_daemon.kinematics import rotation as rot
from jointfit_daemon.kinematics.chain import (
    chain_positions,
    joint_positions,
    joint_positions_one,
)
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion

LENGTHS = (0.42, 0.40)


def test_a_standing_leg_hangs_straight_down() -> None:
    joints = joint_positions((0.1, 0.2, 0.9), np.tile(rot.IDENTITY, (2, 1)), LENGTHS)
    assert np.allclose(joints, [(0.1, 0.2, 0.9), (0.1, 0.2, 0.48), (0.1, 0.2, 0.08)])


def test_a_bent_knee_takes_the_ankle_back() -> None:
    q = np.stack([rot.IDENTITY, rot.exp([-np.pi / 2, 0, 0])])
    joints = joint_positions((0, 0, 0), q, LENGTHS)
    assert np.allclose(joints[2], (0, -0.40, -0.42))


def test_arrays_of_frames_and_single_frames_agree() -> None:
    rng = np.random.default_rng(0)
    q = rot.normalize(rng.normal(size=(50, 2, 4)))
    origin = rng.normal(size=(50, 3))
    joints = joint_positions(origin, q, LENGTHS)
    assert joints.shape == (50, 3, 3)
    offsets = [(0.0, 0.0, -length) for length in LENGTHS]
    for i in range(50):
        x, y, z = origin[i].tolist()
        one = joint_positions_one((x, y, z), [as_quaternion(s) for s in q[i]], offsets)
        assert np.allclose(one, joints[i])
    assert np.allclose(np.linalg.norm(np.diff(joints, axis=1), axis=2), LENGTHS)


def test_the_claimed_covariance_is_what_noise_shows() -> None:
    rng = np.random.default_rng(1)
    n = 40_000
    q = np.stack([rot.exp([0.4, 0.1, 0.2]), rot.exp([-0.6, 0.0, -0.3])])
    spreads = np.stack([np.diag([0.03, 0.02, 0.05]), np.diag([0.01, 0.04, 0.02])]) ** 2
    length_sds = np.array([0.006, 0.004])
    claimed = chain_positions(
        (0, 0, 0),
        q,
        LENGTHS,
        orientation_covariances=spreads,
        length_sds=length_sds,
        origin_covariance=np.eye(3) * 0.003**2,
    )
    noise = rng.normal(size=(n, 2, 3)) * np.sqrt(np.diagonal(spreads, axis1=1, axis2=2))
    noisy = rot.multiply(q, rot.exp(noise))
    lengths = np.array(LENGTHS) + rng.normal(size=(n, 2)) * length_sds
    steps = rot.rotate(noisy, lengths[..., None] * np.array([0, 0, -1.0]))
    drawn = np.cumsum(steps, axis=1) + rng.normal(0, 0.003, (n, 1, 3))
    for joint in (1, 2):
        seen = np.cov(drawn[:, joint - 1].T)
        assert np.allclose(seen, claimed.covariances[joint], rtol=0.05, atol=5e-6)
    assert np.allclose(claimed.covariances[0], np.eye(3) * 0.003**2)


def test_the_patents_axis_puts_the_knee_above_the_hip() -> None:
    joints = joint_positions((0, 0, 0), rot.IDENTITY[None], (0.4,), axis=(0, 0, 1))
    assert joints[1, 2] == pytest.approx(0.4)
