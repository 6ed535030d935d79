"""Joint angles, compared with Euler sequences of SciPy, finite differences and geometry."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.baselines.joint_angle_arrays import (
    anatomical,
    grood_suntay,
    included_angle,
    patent_angles,
)
from jointfit_daemon.kinematics import rotation as rot
from jointfit_daemon.kinematics.joint_angles import (
    functional_axis,
    joint_rotation,
    read_joint,
    read_patent,
    swing_twist,
)
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion

if TYPE_CHECKING:
    from numpy.typing import NDArray

DEG = math.pi / 180.0
LOCKED = np.array([[0.4, math.pi / 2, 0.9], [-0.4, -math.pi / 2, 0.2], [0.1, math.pi / 2, 3.0]])
"""Rotations about z, y and x, rad. With these angles, the rotations about z and x have one axis."""


def random_rotations(count: int, seed: int = 0) -> NDArray[np.float64]:
    return rot.normalize(np.random.default_rng(seed).normal(size=(count, 4)))


def from_sequence(axes: str, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(Rotation.from_euler(axes, angles).as_quat(scalar_first=True))


def test_both_sequences_round_trip_on_twenty_thousand_rotations() -> None:
    q = random_rotations(20_000)
    patent, grood = patent_angles(q), grood_suntay(q)
    back = from_sequence("ZYX", patent.angles[:, ::-1])
    assert np.max(rot.angle_between(back, q)[~patent.gimbal]) < 1e-9
    back = from_sequence("XYZ", grood.angles)
    assert np.max(rot.angle_between(back, q)[~grood.gimbal]) < 1e-9
    assert np.mean(grood.gimbal) < 1e-3


@pytest.mark.parametrize("theta", [math.pi / 2, -math.pi / 2, math.pi / 2 - 1e-6])
def test_gimbal_lock_is_flagged_and_keeps_the_rotation(theta: float) -> None:
    q = from_sequence("XYZ", np.array([[0.4, theta, 0.9]]))
    found = grood_suntay(q)
    assert found.gimbal.all()
    assert found.angles[0, 2] == 0.0
    assert rot.angle_between(from_sequence("XYZ", found.angles), q)[0] < 1e-5
    q = from_sequence("ZYX", np.array([[0.4, theta, 0.9]]))
    patent = patent_angles(q)
    assert patent.gimbal.all()
    assert rot.angle_between(from_sequence("ZYX", patent.angles[:, ::-1]), q)[0] < 1e-5


def test_a_flexed_and_adducted_joint_reads_differently_by_each_definition() -> None:
    # A right knee has 60 degrees of flexion and 20 degrees of adduction. The expected values are
    # independent of this program.
    q = from_sequence("XYZ", np.array([-60.0, 20.0, 0.0]) * DEG)
    assert patent_angles(q).angles[0] / DEG == pytest.approx(-61.5, abs=0.05)
    assert float(included_angle(q)) / DEG == pytest.approx(62.0, abs=0.05)
    assert float(swing_twist(q, [1, 0, 0])[1]) / DEG == pytest.approx(-60.0, abs=0.5)
    assert (math.pi - float(included_angle(q))) / DEG == pytest.approx(118.0, abs=0.05)


def test_pure_flexion_is_the_same_by_every_definition() -> None:
    flexion = np.linspace(0.0, 2.5, 26)
    q = rot.exp(np.outer(-flexion, [1.0, 0.0, 0.0]))
    signed = anatomical(grood_suntay(q).angles, flexion_sign=-1.0, left=False)
    assert np.allclose(signed[:, 0], flexion)
    assert np.allclose(signed[:, 1:], 0.0)
    assert np.allclose(included_angle(q), flexion)
    assert np.allclose(-patent_angles(q).angles[:, 0], flexion)
    assert np.allclose(-swing_twist(q, [1.0, 0.0, 0.0])[1], flexion)


def mirrored(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation reflected about the sagittal plane."""
    return np.multiply(q, [1.0, 1.0, -1.0, -1.0])


def test_a_mirrored_limb_reads_the_same() -> None:
    right = random_rotations(200, 3)
    one = anatomical(grood_suntay(right).angles, flexion_sign=-1.0, left=False)
    other = anatomical(grood_suntay(mirrored(right)).angles, flexion_sign=-1.0, left=True)
    assert np.allclose(one, other)


def test_heel_back_thigh_forward_and_toes_up_are_positive() -> None:
    thigh_forward = rot.exp([0.5, 0.0, 0.0])  # the hanging thigh's lower end comes forward, to +y
    assert rot.rotate(thigh_forward, [0, 0, -1])[1] > 0
    hip = read_joint((1, 0, 0, 0), as_quaternion(thigh_forward), flexion_sign=1.0, left=False)
    assert hip.angles.flexion == pytest.approx(0.5)
    heel_back = rot.exp([-0.5, 0.0, 0.0])
    assert rot.rotate(heel_back, [0, 0, -1])[1] < 0
    knee = read_joint((1, 0, 0, 0), as_quaternion(heel_back), flexion_sign=-1.0, left=True)
    assert knee.angles.flexion == pytest.approx(0.5)


def test_adduction_brings_a_right_foot_to_the_midline_and_toes_turn_in() -> None:
    adducted = rot.exp([0.0, 0.3, 0.0])
    assert rot.rotate(adducted, [0, 0, -1])[0] < 0  # the midline lies to the left of a right leg
    assert grood_suntay(adducted).angles[1] == pytest.approx(0.3)
    turned_in = rot.exp([0.0, 0.0, 0.3])
    assert rot.rotate(turned_in, [0, 1, 0])[0] < 0
    assert grood_suntay(turned_in).angles[2] == pytest.approx(0.3)


@pytest.mark.parametrize("left", [False, True])
def test_one_frame_reads_as_the_arrays_do(left: bool) -> None:
    """The function for one frame returns the angles of the function for arrays."""
    proximal, distal = random_rotations(300, 1), random_rotations(300, 2)
    q = joint_rotation(proximal, distal)
    expected = anatomical(grood_suntay(q).angles, flexion_sign=-1.0, left=left)
    for i in range(300):
        one = read_joint(
            as_quaternion(proximal[i]), as_quaternion(distal[i]), flexion_sign=-1.0, left=left
        )
        assert one.angles == pytest.approx(tuple(expected[i]), abs=1e-12)
        assert one.inner == pytest.approx(math.pi - float(included_angle(q[i])), abs=1e-12)


def test_one_frame_reads_the_patents_angles_as_the_arrays_do() -> None:
    """The function for one frame returns the patent's angles like the function for arrays."""
    proximal = random_rotations(300, 1)
    turns = np.vstack((random_rotations(297, 2), from_sequence("ZYX", LOCKED)))
    distal = rot.multiply(proximal, turns)
    expected = patent_angles(joint_rotation(proximal, distal))
    assert expected.gimbal.sum() == len(LOCKED)
    for i in range(300):
        one = read_patent(as_quaternion(proximal[i]), as_quaternion(distal[i]))
        assert one[:3] == pytest.approx(tuple(expected.angles[i]), abs=1e-9)
        assert one.joint == pytest.approx(math.pi - abs(expected.angles[i, 0]), abs=1e-9)
        assert one.gimbal == expected.gimbal[i]


def test_swing_and_twist_make_the_rotation_and_swing_does_not_twist() -> None:
    q, axis = random_rotations(500), np.array([0.6, 0.0, -0.8])
    swing, twist = swing_twist(q, axis)
    whole = rot.multiply(swing, rot.exp(twist[:, None] * axis))
    assert np.max(rot.angle_between(whole, q)) < 1e-9
    assert np.allclose(swing[:, 1:] @ axis, 0.0, atol=1e-12)
    assert np.all((twist > -np.pi) & (twist <= np.pi))


def test_the_functional_axis_is_found_and_points_right() -> None:
    axis = np.array([0.95, 0.05, -0.3]) / np.linalg.norm([0.95, 0.05, -0.3])
    noise = np.random.default_rng(4).normal(0, 0.01, (200, 3))
    q = rot.multiply(rot.exp(np.outer(np.linspace(-1.5, 0, 200), axis)), rot.exp(noise))
    assert np.linalg.norm(functional_axis(q) - axis) < 0.01


def test_rounding_beyond_one_gives_a_right_angle_not_nan() -> None:
    q = np.array([[0.5, 0.5, 0.5, 0.5], [math.sqrt(0.5), 0, math.sqrt(0.5), 0]]) * (1 + 1e-15)
    assert np.isfinite(grood_suntay(q).angles).all()
    assert np.isfinite(patent_angles(q).angles).all()
    reading = read_joint((1, 0, 0, 0), as_quaternion(q[1]), flexion_sign=1.0, left=False)
    assert reading.gimbal
    assert math.isfinite(reading.angles.adduction)
