"""Angle conventions of shoulder, elbow, wrist and trunk, compared with rotations of SciPy."""

from __future__ import annotations

from math import cos, degrees, hypot, inf, isfinite, pi, radians, sin

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.fusion._angle_rates import AngleRates
from jointfit_daemon.fusion._forward_kinematics import joint_angle_estimate
from jointfit_daemon.fusion._segment_fuser import FusedSegment
from jointfit_daemon.kinematics.joint_angles import JointReading, read_joint
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import angle_convention
from jointfit_daemon.model import AngleConvention, Chain, Quaternion

ELEVATION, TILT = AngleConvention.ELEVATION, AngleConvention.TILT_TORSION
TRUNK, FLEXION = AngleConvention.TRUNK, AngleConvention.FLEXION
REST = (1.0, 0.0, 0.0, 0.0)
TURNS = st.floats(-pi, pi)


def quaternion(turn: Rotation) -> Quaternion:
    return as_quaternion(turn.as_quat(scalar_first=True))


def read(turn: Rotation, convention: AngleConvention, *, left: bool = False) -> JointReading:
    """Return the angles of a joint with the rotation `turn`; the proximal segment is rotated."""
    world = Rotation.from_rotvec([0.3, -1.1, 0.7])
    one, other = quaternion(world), quaternion(world * turn)
    return read_joint(one, other, flexion_sign=1.0, left=left, convention=convention)


def apart(a: float, b: float) -> float:
    return abs((a - b + pi) % (2.0 * pi) - pi)


@given(TURNS, st.floats(0.02, pi - 0.02), TURNS)
def test_elevation_is_the_sequence_y_x_y_of_the_isb(
    plane: float, elevation: float, axial: float
) -> None:
    turn = Rotation.from_euler("ZYZ", [plane, -elevation, axial])
    reading = read(turn, ELEVATION)
    for found, given_angle in zip(reading.angles, (plane, elevation, axial), strict=True):
        assert apart(found, given_angle) < 1e-9
    assert not reading.gimbal
    assert reading.inner == pytest.approx(pi - elevation)


@pytest.mark.parametrize(
    ("turn", "left", "plane_deg", "elevation_deg", "rotation_deg"),
    [
        (Rotation.from_euler("y", -90, degrees=True), False, 0, 90, 0),  # right arm to the right
        (Rotation.from_euler("y", 90, degrees=True), True, 0, 90, 0),  # left arm to the left
        (Rotation.from_euler("x", 90, degrees=True), False, 90, 90, -90),  # forward
        (Rotation.from_euler("x", 90, degrees=True), True, 90, 90, -90),
    ],
)
def test_arms_raised_sideways_and_forward_have_the_angles_of_the_isb_on_both_sides(
    turn: Rotation, left: bool, plane_deg: float, elevation_deg: float, rotation_deg: float
) -> None:
    angles = read(turn, ELEVATION, left=left).angles
    expected = (plane_deg, elevation_deg, rotation_deg)
    assert np.allclose(np.degrees(angles), expected, atol=1e-9)


@given(st.floats(0.0, pi - 0.05), TURNS, TURNS)
def test_tilt_and_torsion_compose_to_the_rotation(
    tilt: float, plane: float, torsion: float
) -> None:
    swing = Rotation.from_rotvec([tilt * cos(plane), tilt * sin(plane), 0.0])
    flexion, adduction, found = read(swing * Rotation.from_euler("z", torsion), TILT).angles
    assert (flexion, adduction) == pytest.approx((tilt * cos(plane), tilt * sin(plane)), abs=1e-9)
    assert apart(found, torsion) < 1e-9


@given(TURNS, st.floats(0.0, pi), TURNS, st.sampled_from([ELEVATION, TILT, FLEXION]))
def test_a_mirrored_left_limb_has_the_angles_of_the_right_one(
    plane: float, elevation: float, axial: float, convention: AngleConvention
) -> None:
    turn = Rotation.from_euler("ZYZ", [plane, -elevation, axial])
    x, y, z = turn.as_rotvec()
    right = read(turn, convention)
    left = read(Rotation.from_rotvec([x, -y, -z]), convention, left=True)
    assume(not right.gimbal and not left.gimbal)
    assert max(map(apart, right.angles, left.angles)) < 1e-6


@pytest.mark.parametrize("convention", [ELEVATION, TILT])
@given(
    rotated=st.floats(-1.2, 1.2),
    plane=st.floats(-0.4, 1.8),
    sd=st.floats(0.002, 0.1),
)
def test_a_shoulder_swept_through_90_degrees_has_no_jump_no_lock_and_finite_sd(
    convention: AngleConvention, rotated: float, plane: float, sd: float
) -> None:
    """The elevation increases from 20 to 160 degrees, by one degree per frame."""
    rates, before = AngleRates(), None
    for frame in range(141):
        turn = Rotation.from_euler("ZYZ", [plane, -radians(20.0 + frame), rotated])
        state = joint_angle_estimate(
            FusedSegment(REST, sd, (), ()),
            FusedSegment(quaternion(turn), sd, (), ()),
            sign=1.0,
            left=False,
            convention=convention,
        )
        assert state is not None
        assert not state.gimbal
        assert state.main_sd is not None
        assert sd <= state.main_sd < 12.0 * sd  # magnified by tilt / sin(tilt) = 8.2 at 160 degrees
        if before is not None:
            # no angle changes by more than the one degree of the movement
            assert max(map(apart, state.angles, before)) < radians(1.001)
        before = state.angles
        rate = rates.update(frame * 10_000_000, "shoulder", state.angles, gimbal=state.gimbal)
        assert frame == 0 or (rate is not None and max(map(abs, rate)) < radians(100.1))


def test_the_sequence_of_the_knee_locks_where_the_shoulder_does_not() -> None:
    abducted = Rotation.from_euler("y", -90, degrees=True)
    assert read(abducted, FLEXION).gimbal
    assert read(abducted, FLEXION).sd_factor == inf
    for convention in (ELEVATION, TILT):
        reading = read(abducted, convention)
        assert not reading.gimbal
        assert isfinite(reading.sd_factor)


@pytest.mark.parametrize("elevation", [0.0, 1e-9, pi - 1e-9, pi])
@given(axial=st.floats(-3.0, 3.0))
def test_a_hanging_or_overhead_arm_is_flagged_and_keeps_elevation_and_rotation(
    elevation: float, axial: float
) -> None:
    turn = Rotation.from_euler("ZYZ", [0.0, -elevation, axial])
    reading = read(turn, ELEVATION)
    assert reading.gimbal
    assert reading.sd_factor == 1.0
    assert reading.angles[0] == 0.0
    assert reading.angles[1] == pytest.approx(elevation, abs=1e-7)
    assert apart(reading.angles[2], axial) < 1e-6


def test_tilt_is_regular_in_the_hanging_arm_and_flagged_overhead() -> None:
    hanging = read(Rotation.from_euler("z", 0.4), TILT)
    assert not hanging.gimbal
    assert hanging.angles == pytest.approx((0.0, 0.0, 0.4))
    overhead = read(Rotation.from_rotvec([0.0, -pi, 0.0]), TILT)
    assert overhead.gimbal
    assert hypot(*overhead.angles[:2]) == pytest.approx(pi)


@pytest.mark.parametrize("tilt_deg", [5.0, 90.0, 140.0])
def test_sd_of_tilt_matches_monte_carlo(tilt_deg: float) -> None:
    rng = np.random.default_rng(3)
    tilt, plane, sd = radians(tilt_deg), 0.9, 0.01
    turn = Rotation.from_rotvec([tilt * cos(plane), tilt * sin(plane), 0.0])
    turn *= Rotation.from_euler("z", 0.5)
    noisy = turn * Rotation.from_rotvec(rng.normal(0.0, sd, (1500, 3)))
    flexion = [read(one, TILT).angles[0] for one in noisy]
    assert sd * read(turn, TILT).sd_factor == pytest.approx(np.std(flexion), rel=0.07)


@given(st.floats(-1.4, 1.4), st.floats(-1.4, 1.4), st.floats(-1.4, 1.4))
def test_trunk_angles_are_those_of_the_upper_segment_on_the_lower_one(
    bend: float, right: float, turned: float
) -> None:
    """Positive angles are flexion forward, bending to the right and rotation to the left.

    The upper segment is the proximal segment.
    """
    upper_on_lower = Rotation.from_euler("XYZ", [-bend, right, turned])
    reading = read(upper_on_lower.inv(), TRUNK)
    assert reading.angles == pytest.approx((bend, right, turned), abs=1e-9)
    assert reading.sd_factor == pytest.approx(1.0 / cos(right))


def test_signs_of_the_trunk() -> None:
    head_end = np.array([0.0, 0.0, 1.0])
    forward = Rotation.from_euler("x", -30, degrees=True)
    assert forward.apply(head_end)[1] > 0.4  # y is anterior
    assert degrees(read(forward.inv(), TRUNK).angles[0]) == pytest.approx(30.0)
    to_the_right = Rotation.from_euler("y", 20, degrees=True)
    assert to_the_right.apply(head_end)[0] > 0.3  # x is to the right
    assert degrees(read(to_the_right.inv(), TRUNK).angles[1]) == pytest.approx(20.0)


def test_the_name_of_a_joint_selects_its_convention_unless_configured() -> None:
    joints = ("neck", "left_shoulder", "Elbow", "wrist", "lumbar_spine", "hip", "knee", "thing")
    chain = Chain(joints, ("s",) * 7, ((),) * 7)
    assert [angle_convention(chain, i) for i in range(len(joints))] == [
        TRUNK, ELEVATION, FLEXION, FLEXION, TRUNK, FLEXION, FLEXION, FLEXION,
    ]  # fmt: skip
    chosen = Chain(joints, ("s",) * 7, ((),) * 7, conventions=(None, TILT, *(None,) * 6))
    assert angle_convention(chosen, 1) is TILT
    assert angle_convention(chosen, 0) is TRUNK
