"""Conversion of optical poses to a world with z up."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_drivers.motion_capture import matrix_quaternion, unit_quaternion, world_rotation

UP = {
    "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0), "-y": (0.0, -1.0, 0.0), "-z": (0.0, 0.0, -1.0),
}  # fmt: skip
"""Up direction of the stream, in its own axes."""
ANGLES = st.floats(-np.pi, np.pi)


def rotation(q: tuple[float, ...] | None) -> Rotation:
    assert q is not None
    return Rotation.from_quat(np.roll(q, -1))


@pytest.mark.parametrize("axis", UP)
def test_up_of_the_stream_becomes_z(axis: str) -> None:
    place, _ = world_rotation(axis)
    assert place(*UP[axis]) == pytest.approx((0, 0, 1))


@pytest.mark.parametrize("axis", UP)
@given(ANGLES, ANGLES, ANGLES)
def test_orientations_turn_as_positions_do(axis: str, a: float, b: float, c: float) -> None:
    place, turn = world_rotation(axis)
    body = Rotation.from_euler("xyz", (a, b, c))
    x, y, z, w = body.as_quat()
    point = np.array((0.3, -0.2, 0.9))
    turned = rotation(turn(w, x, y, z)).apply(point)
    assert turned == pytest.approx(np.array(place(*body.apply(point))), abs=1e-12)


@given(ANGLES, ANGLES, ANGLES)
def test_a_matrix_gives_the_quaternion_of_its_rotation(a: float, b: float, c: float) -> None:
    truth = Rotation.from_euler("xyz", (a, b, c))
    found = matrix_quaternion(truth.as_matrix().ravel().tolist())
    assert (rotation(found).inv() * truth).magnitude() < 1e-9


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (-1, 2, 3)])
def test_half_turns_have_a_quaternion(axis: tuple[int, int, int]) -> None:
    truth = Rotation.from_rotvec(np.pi * np.array(axis) / np.linalg.norm(axis))
    found = matrix_quaternion(truth.as_matrix().ravel().tolist())
    assert (rotation(found).inv() * truth).magnitude() < 1e-9


@pytest.mark.parametrize(
    "rows",
    [
        [0.0] * 9,
        [float("nan")] * 9,
        [float("inf")] * 9,
        [1.0, 0, 0, 0, 1, 0, 0, 0, -1],  # a reflection
        [1.02, 0, 0, 0, 1, 0, 0, 0, 1],
        [1.0, 0.02, 0, 0, 1, 0, 0, 0, 1],
    ],
)
def test_a_matrix_that_is_no_rotation_is_refused(rows: list[float]) -> None:
    assert matrix_quaternion(rows) is None


def test_a_quaternion_is_accepted_only_with_a_norm_near_one() -> None:
    assert unit_quaternion(1.0005, 0.0, 0.0, 0.0) == (1.0, 0.0, 0.0, 0.0)
    assert unit_quaternion(1.002, 0.0, 0.0, 0.0) is None
    assert unit_quaternion(float("nan"), 0.0, 0.0, 0.0) is None
