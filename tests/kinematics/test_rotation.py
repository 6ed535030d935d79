"""Rotations, compared with SciPy and with properties of the rotation group."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.kinematics import rotation as rot
from jointfit_daemon.kinematics import rotation_scalar as one

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]

components = st.floats(-10.0, 10.0, allow_subnormal=False)
vectors = st.tuples(components, components, components)
quaternions = (
    st.tuples(components, components, components, components)
    .filter(lambda q: math.hypot(*q) > 1e-3)
    .map(one.normalize_one)
)


def oracle(q: ArrayLike) -> Rotation:
    return Rotation.from_quat(np.asarray(q), scalar_first=True)


def same_rotation(a: ArrayLike, b: ArrayLike, tolerance: float = 1e-9) -> bool:
    return bool(np.all(rot.angle_between(a, b) < tolerance))


@given(quaternions, quaternions)
def test_products_chain_as_scipy_chains_them(p: Quaternion, q: Quaternion) -> None:
    expected = (oracle(p) * oracle(q)).as_quat(scalar_first=True)
    assert same_rotation(rot.multiply(p, q), expected)
    assert one.multiply_one(p, q) == pytest.approx(tuple(rot.multiply(p, q)), abs=1e-14)
    assert one.between_one(p, q) == pytest.approx(
        tuple(rot.multiply(rot.conjugate(p), q)), abs=1e-14
    )


@given(quaternions, vectors)
def test_a_vector_turns_as_scipy_turns_it(q: Quaternion, v: Vector) -> None:
    expected = oracle(q).apply(v)
    assert np.allclose(rot.rotate(q, v), expected, atol=1e-12)
    assert np.allclose(one.rotate_one(q, v), expected, atol=1e-12)
    assert np.allclose(rot.to_matrix(q) @ np.array(v), expected, atol=1e-12)


@given(quaternions, quaternions, vectors)
def test_combined_functions_equal_two_calls(p: Quaternion, q: Quaternion, r: Vector) -> None:
    assert one.difference_one(p, q) == one.log_one(one.between_one(p, q))
    assert one.perturb_one(p, r) == one.multiply_one(p, one.exp_one(r))


@given(quaternions, components)
def test_rotation_of_a_vector_along_z_equals_the_general_rotation(
    q: Quaternion, length: float
) -> None:
    assert one.rotate_z_one(q, length) == one.rotate_one(q, (0.0, 0.0, length))


@given(quaternions)
def test_log_is_the_rotation_vector_and_exp_its_inverse(q: Quaternion) -> None:
    vector = rot.log(q)
    assert np.allclose(oracle(q).magnitude(), np.linalg.norm(vector), atol=1e-9)
    assert same_rotation(Rotation.from_rotvec(vector).as_quat(scalar_first=True), q)
    assert same_rotation(rot.exp(vector), q)
    assert np.allclose(one.log_one(q), vector, atol=1e-14)
    assert np.allclose(one.exp_one(tuple(vector)), rot.exp(vector), atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-9, 1e-6, 1e-3, 3.0, math.pi - 1e-9])
def test_no_digit_is_lost_at_small_or_large_angles(angle: float) -> None:
    r = np.array([0.6, 0.0, 0.8]) * angle
    assert np.allclose(rot.log(rot.exp(r)), r, rtol=1e-13, atol=0.0)
    assert np.allclose(one.log_one(one.exp_one(tuple(r))), r, rtol=1e-13, atol=0.0)
    assert rot.angle_between(rot.IDENTITY, rot.exp(r)) == pytest.approx(angle, rel=1e-12)


@given(quaternions)
def test_quaternion_sign_does_not_change_the_rotation(q: Quaternion) -> None:
    negative = tuple(-c for c in q)
    assert np.allclose(rot.log(q), rot.log(negative)) or np.linalg.norm(rot.log(q)) > 3.1415
    assert float(rot.angle_between(q, negative)) < 1e-7
    assert same_rotation(rot.from_matrix(rot.to_matrix(q)), q, 1e-7)


def test_matrices_round_trip_also_at_half_turns() -> None:
    q = np.vstack(
        [np.eye(4), rot.normalize(np.array([[0.0, 1, 1, 0], [0, 0, -1, 1], [1e-9, 1, 2, 3]]))]
    )
    assert same_rotation(rot.from_matrix(rot.to_matrix(q)), q)
    assert np.all(rot.from_matrix(rot.to_matrix(q))[:, 0] >= 0)


@given(quaternions, quaternions, st.floats(0.0, 1.0))
def test_interpolation_uses_the_shortest_rotation(p: Quaternion, q: Quaternion, a: float) -> None:
    whole = float(rot.angle_between(p, q))
    point = rot.interpolate(p, q, a)
    assert float(rot.angle_between(p, point)) == pytest.approx(a * whole, abs=1e-9)
    assert np.allclose(one.interpolate_one(p, q, a), point, atol=1e-12)


def test_the_mean_equals_scipys_for_any_signs() -> None:
    rng = np.random.default_rng(1)
    q = rot.multiply(rot.exp([0.3, -0.8, 2.0]), rot.exp(rng.normal(0, 0.3, (50, 3))))
    weights = rng.uniform(0.1, 2.0, 50)
    expected = oracle(q).mean(weights).as_quat(scalar_first=True)
    flipped = q * rng.choice([-1.0, 1.0], 50)[:, None]
    assert same_rotation(rot.average(flipped, weights), expected)
    assert rot.average(np.stack([q, q]), np.stack([weights, weights])).shape == (2, 4)
    with pytest.raises(ValueError, match="no rotations"):
        rot.average(np.empty((0, 4)))


def test_a_series_becomes_continuous_across_gaps_and_whole_turns() -> None:
    angles = np.linspace(0, 4 * np.pi, 200)
    q = (
        rot.exp(np.outer(angles, [0.0, 0.0, 1.0]))
        * np.where(np.arange(200) % 7 < 3, -1, 1)[:, None]
    )
    q[50:53] = np.nan
    series = rot.continuous(q)
    seen = series[np.isfinite(series[:, 0])]
    assert np.all(np.sum(seen[1:] * seen[:-1], axis=1) > 0)
    assert np.isnan(series[50:53]).all()
    assert np.all(np.sum(rot.align_hemisphere(q, rot.IDENTITY)[:, :1], axis=1)[:50] >= 0)


@given(quaternions, quaternions)
def test_product_matrices_multiply(p: Quaternion, q: Quaternion) -> None:
    expected = rot.multiply(p, q)
    assert np.allclose(rot.left_matrix(p) @ np.array(q), expected)
    assert np.allclose(rot.right_matrix(q) @ np.array(p), expected)


@given(vectors, vectors)
def test_skew_is_the_cross_product(v: Vector, u: Vector) -> None:
    assert np.allclose(rot.skew(v) @ np.array(u), np.cross(v, u))


@pytest.mark.parametrize("angle", [-3.0, -0.5, 0.0, 0.7, 3.1])
def test_heading_is_the_turn_about_the_vertical(angle: float) -> None:
    assert np.allclose(rot.rotate(rot.heading(angle), [1, 0, 0]), [np.cos(angle), np.sin(angle), 0])
    assert float(rot.heading_of(-rot.heading(angle))) == pytest.approx(angle)
    tilted = rot.multiply(rot.heading(angle), rot.exp([0.4, -0.2, 0.0]))
    assert float(rot.heading_of(tilted)) == pytest.approx(angle)


def test_zero_quaternion_normalizes_to_nan() -> None:
    assert np.isnan(rot.normalize(np.array([[0.0, 0, 0, 0], [np.nan, 1, 0, 0]]))).all()
    with pytest.raises(ZeroDivisionError):
        one.normalize_one((0.0, 0.0, 0.0, 0.0))


@given(quaternions)
def test_scalar_matrix_conversion_equals_that_of_arrays(q: Quaternion) -> None:
    assert one.to_matrix_one(q) == pytest.approx(rot.to_matrix(q), abs=1e-12)
