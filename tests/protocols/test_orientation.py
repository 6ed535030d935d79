"""The conversion to canonical orientations agrees with SciPy; wrong norms are rejected."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_protocols.orientation import (
    OrientationGate,
    angles_quaternion,
    canonical,
    native_of,
)

unit = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(lambda q: tuple(part / math.hypot(*q) for part in q))
)
worlds: Any = st.sampled_from(["ENU", "NED", "NWU"])
ENU_FROM = {  # v_enu = matrix @ v_native
    "ENU": np.eye(3),
    "NED": np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]),
    "NWU": np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}


def rotation(q: Any) -> Rotation:
    w, x, y, z = q
    return Rotation.from_quat([x, y, z, w])


@given(unit, worlds)
def test_vector_is_rotated_as_the_world_table_defines(q: Any, world: Any) -> None:
    vector = np.array([1.0, 2.0, 3.0])
    expected = ENU_FROM[world] @ rotation(q).apply(vector)
    assert rotation(canonical(q, world)).apply(vector) == pytest.approx(expected, abs=1e-12)


@given(unit, worlds)
def test_world_to_sensor_is_the_inverse(q: Any, world: Any) -> None:
    w, x, y, z = q
    turned = canonical((w, -x, -y, -z), world, world_to_sensor=True)
    assert turned == pytest.approx(canonical(q, world), abs=0)


@given(unit, worlds)
def test_native_of_undoes_canonical(q: Any, world: Any) -> None:
    back = canonical(native_of(q, world), world)
    assert abs(np.dot(back, q)) == pytest.approx(1.0, abs=1e-12)


@given(st.lists(unit, min_size=1, max_size=20))
def test_accepted_quaternions_are_unit_with_continuous_sign(path: Any) -> None:
    gate, last = OrientationGate(), None
    for q in path:
        out = gate.admit(tuple(1.005 * part for part in q))
        assert out is not None
        assert math.hypot(*out) == pytest.approx(1.0, abs=1e-12)
        assert abs(np.dot(out, q)) == pytest.approx(1.0, abs=1e-12)
        if last is not None:
            assert np.dot(last, out) >= -1e-12
        last = out


@pytest.mark.parametrize(
    ("norm", "passes"), [(1.0, True), (1.0099, True), (1.011, False), (0.98, False), (0.0, False)]
)
def test_the_norm_decides_whether_a_quaternion_is_accepted(norm: float, passes: bool) -> None:
    assert (OrientationGate().admit((norm, 0.0, 0.0, 0.0)) is not None) == passes


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
def test_non_finite_quaternions_are_rejected(bad: float) -> None:
    assert OrientationGate().admit((bad, 0.0, 0.0, 1.0)) is None


def test_a_wrong_scale_is_recognised_by_its_median_norm() -> None:
    gate = OrientationGate()
    for number in range(99):
        gate.admit((0.5 + 1e-3 * (number % 3 - 1), 0.0, 0.0, 0.0))
    assert gate.misconfigured_norm is None
    gate.admit((0.5, 0.0, 0.0, 0.0))
    assert gate.misconfigured_norm == pytest.approx(0.5)


def test_ten_good_samples_in_a_hundred_are_no_wrong_scale() -> None:
    gate = OrientationGate()
    for number in range(200):
        gate.admit((1.0 if number % 10 == 0 else 0.5, 0.0, 0.0, 0.0))
    assert gate.misconfigured_norm is None


def test_ninety_one_rejected_samples_of_the_first_hundred_are_a_wrong_scale() -> None:
    gate = OrientationGate()
    for number in range(100):
        assert not gate.is_decided
        assert gate.misconfigured_norm is None
        gate.admit((1.0 if number < 9 else 0.5, 0.0, 0.0, 0.0))
    assert gate.is_decided
    assert gate.misconfigured_norm == 0.5
    for _ in range(500):
        gate.admit((1.0, 0.0, 0.0, 0.0))
    assert gate.misconfigured_norm == 0.5  # later samples do not change the median


def test_samples_without_a_finite_norm_have_no_median() -> None:
    gate = OrientationGate()
    for _ in range(100):
        gate.admit((math.nan, 0.0, 0.0, 0.0))
    assert gate.misconfigured_norm is not None
    assert math.isnan(gate.misconfigured_norm)


def test_the_tolerance_limits_the_norm_on_both_sides() -> None:
    gate = OrientationGate(0.05)
    norms = (0.949, 0.951, 1.049, 1.051)
    admitted = [gate.admit((0.0, norm, 0.0, 0.0)) is not None for norm in norms]
    assert admitted == [False, True, True, False]


def test_a_restart_of_the_device_restarts_the_continuity_of_signs() -> None:
    gate = OrientationGate()
    q, turned = (0.6, 0.0, 0.0, 0.8), (-0.6, 0.0, 0.0, 0.8)
    assert OrientationGate().admit(turned) == pytest.approx((0.6, 0.0, 0.0, -0.8))
    assert gate.admit(q) == pytest.approx(q)
    assert gate.admit(turned) == pytest.approx(turned)
    gate.forget()
    assert gate.admit(turned) == pytest.approx((0.6, 0.0, 0.0, -0.8))


@given(*[st.floats(-math.pi, math.pi)] * 3)
def test_angles_are_turned_about_x_then_y_then_z_of_the_world(
    roll: float, pitch: float, yaw: float
) -> None:
    expected = Rotation.from_euler("xyz", [roll, pitch, yaw])
    found = rotation(angles_quaternion(roll, pitch, yaw))
    assert (found * expected.inv()).magnitude() < 1e-7
