"""Coordinates that are computed one instant after another equal the coordinates of a whole trial.

Numerical steps are counted, because times depend on the machine.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_daemon.kinematics.chain_coordinates import (
    JointCoordinates,
    coordinate_table,
    default_coordinates,
)
from jointfit_daemon.kinematics.chains import (
    ChainModel,
    ChainState,
    Joint,
    Segment,
    apply_step,
    exp_matrix,
    rest_state,
)
from jointfit_daemon.kinematics.coordinate_tracking import CoordinateTracker

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

MODEL = ChainModel(
    (
        Segment("pelvis"),
        Segment("thigh", "pelvis", Joint("ball")),
        Segment("shank", "thigh", Joint("hinge", axis=(0.6, 0.0, 0.8), rest=(0.8, 0.6, 0.0, 0.0))),
    ),
    (),
)
RESOLUTION = np.deg2rad(0.005)
"""Half of the last published digit, rad."""
COORDINATES = default_coordinates(MODEL)


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_values_and_standard_deviations_equal_those_of_the_table(seed: int) -> None:
    rng = np.random.default_rng(seed)
    step = rng.normal(0.0, 0.9, MODEL.nq)
    state = apply_step(MODEL, rest_state(MODEL), step[None])
    root = rng.normal(0.0, 0.02, (MODEL.nq, MODEL.nq))
    covariance = root @ root.T
    table = coordinate_table(MODEL, state, covariance[None], COORDINATES)
    if np.abs(table.values[0, [1, 7]]).max() > 1.4:
        return  # near a gimbal lock, rounding errors of the pose cause large angle errors
    values, found = CoordinateTracker(MODEL, COORDINATES).read(state, covariance)
    np.testing.assert_allclose(values, table.values[0], atol=RESOLUTION)
    np.testing.assert_allclose(np.sqrt(found.diagonal()), table.sd[0], rtol=5e-3)


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_covariance_of_coordinates_is_the_covariance_of_small_steps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state = apply_step(MODEL, rest_state(MODEL), rng.normal(0.0, 0.3, (1, MODEL.nq)))
    root = rng.normal(0.0, 0.02, (MODEL.nq, MODEL.nq))
    values, found = CoordinateTracker(MODEL, COORDINATES).read(state, root @ root.T)

    # Coordinates after small steps, from a new tracker each time.
    def moved(step: Array) -> Array:
        tracker = CoordinateTracker(MODEL, COORDINATES)
        return tracker.read(apply_step(MODEL, state, step[None]), np.eye(MODEL.nq))[0]

    slopes = np.stack([(moved(1e-6 * e) - values) / 1e-6 for e in np.eye(MODEL.nq)], axis=1)
    expected = slopes @ root @ root.T @ slopes.T
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_each_instant_begins_at_the_one_before() -> None:
    tracker = CoordinateTracker(MODEL, COORDINATES)
    state, covariance = rest_state(MODEL), 1e-4 * np.eye(MODEL.nq)
    for _ in range(40):
        step = np.concatenate((np.full(3, 0.05), np.full(3, 0.01), np.full(4, 0.08)))
        state = apply_step(MODEL, state, step[None])
        table = coordinate_table(MODEL, state, covariance[None], COORDINATES)
        values, _ = tracker.read(state, covariance)
        turns = (values - table.values[0]) / (2.0 * np.pi) * np.array(table.is_angle)
        off = values - table.values[0] - 2.0 * np.pi * np.round(turns)
        assert np.abs(off).max() < RESOLUTION


def test_a_joint_of_two_angles_has_coordinates_although_noise_leaves_a_third() -> None:
    """Noise causes a small rotation that the two angles of the joint cannot describe."""
    model = ChainModel((Segment("forearm"), Segment("hand", "forearm", Joint("ball"))), ())
    forearm, hand = default_coordinates(model)
    assert hand.pose is not None
    pose = hand.pose
    wrist = JointCoordinates(
        "hand",
        ("flexion", "deviation"),
        (True, True),
        lambda values: pose(np.column_stack((values, np.zeros(len(values))))),
    )
    tracker = CoordinateTracker(model, (forearm, wrist))
    rng, covariance = np.random.default_rng(1), 1e-4 * np.eye(model.nq)
    for k in range(50):
        step = np.zeros((1, model.nq))
        step[0, model.columns[1]] = rng.normal(0.0, 0.01, 3)
        step[0, model.columns[1].start] += 0.5 * np.sin(0.1 * k)
        state = apply_step(model, rest_state(model), step)
        values, found = tracker.read(state, covariance)
        assert values[-2:] == pytest.approx([0.5 * np.sin(0.1 * k), 0.0], abs=0.05)
        assert np.isfinite(found).all()


MOST_STEPS = 8
"""Largest number of numerical steps in one instant with one joint without closed form."""


def sequence(name: str, axes: Array, is_free: bool = False) -> JointCoordinates:
    """Return a joint with rotations about three axes and, if free, translations with an offset."""
    fixed = exp_matrix(np.array([0.2, -0.5, 0.9]))

    def pose(values: Array) -> tuple[Array, Array]:
        first, second, third = (exp_matrix(values[:, k, None] * axes[k]) for k in range(3))
        A = fixed @ first @ second @ third @ fixed
        return A, values[:, 3:] @ fixed.T + A @ [0.1, 0.2, -0.3] + 0.5 if is_free else 0.0 * A[:, 0]

    kinds = (True,) * 3 + (False,) * (3 if is_free else 0)
    return JointCoordinates(name, tuple(f"{name}_{k}" for k in range(len(kinds))), kinds, pose, 1)


def counted(joint: JointCoordinates, calls: list[int]) -> JointCoordinates:
    """Return a joint that adds the evaluations of its pose to `calls`."""
    assert joint.pose is not None
    pose = joint.pose

    def counting(values: Array) -> tuple[Array, Array]:
        calls[0] += 1
        return pose(values)

    return replace(joint, pose=counting)


def ball_state(rotations: Array) -> ChainState:
    return ChainState(np.stack((np.eye(3), rotations))[None], np.zeros((1, 1, 3)))


BALL = ChainModel((Segment("pelvis"), Segment("thigh", "pelvis", Joint("ball"))), ())
OBLIQUE = np.array([[1.0, 0.0, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
HANDS = {"right": np.eye(3), "left": np.diag([1.0, 1.0, -1.0]), "other order": np.eye(3)[[2, 0, 1]]}


@pytest.mark.parametrize("axes", HANDS.values(), ids=HANDS)
@pytest.mark.parametrize("seed", range(5))
def test_perpendicular_axes_have_a_closed_form_that_equals_the_table(
    axes: Array, seed: int
) -> None:
    calls, rng = [0], np.random.default_rng(seed)
    coordinates = (
        counted(sequence("pelvis", axes, is_free=True), calls),
        counted(sequence("thigh", axes), calls),
    )
    values = np.concatenate((rng.uniform(-1.4, 1.4, 3), rng.normal(0.0, 2.0, 3)))
    values = np.concatenate((values, rng.uniform(-1.4, 1.4, 3)))
    poses = [
        joint.pose(values[None, at])
        for joint, at in zip(coordinates, (slice(0, 6), slice(6, 9)), strict=True)
        if joint.pose is not None
    ]
    state = ChainState(np.stack([A for A, _ in poses], axis=1), poses[0][1][None])
    root = rng.normal(0.0, 0.02, (9, 9))
    table = coordinate_table(BALL, state, (root @ root.T)[None], coordinates)

    tracker = CoordinateTracker(BALL, coordinates)
    calls[0] = 0
    found, covariance = tracker.read(state, root @ root.T)
    assert calls == [0]
    np.testing.assert_allclose(found, values, atol=1e-9)
    np.testing.assert_allclose(np.sqrt(covariance.diagonal()), table.sd[0], rtol=1e-5)


def test_oblique_axes_are_inverted_in_few_steps_an_instant() -> None:
    calls, covariance = [0], 1e-4 * np.eye(9)
    thigh = counted(sequence("thigh", OBLIQUE), calls)
    assert thigh.pose is not None
    tracker = CoordinateTracker(BALL, (default_coordinates(BALL)[0], thigh))
    for k in range(60):
        # At k = 31 the first angle jumps, so the earlier values are far from the solution.
        values = np.array([np.sin(0.1 * k) + 2.0 * (k > 30), 0.4 * np.cos(0.2 * k), 0.05 * k - 2.0])
        A = thigh.pose(values[None])[0][0]
        calls[0] = 0
        found, spread = tracker.read(ball_state(A), covariance)
        assert calls[0] <= MOST_STEPS
        if k not in (0, 1, 31, 32):
            np.testing.assert_allclose(found[6:], values, atol=RESOLUTION)
            assert np.isfinite(spread).all()


def test_a_search_without_result_takes_few_steps_an_instant_until_it_ends() -> None:
    # The joint has two angles, which cannot describe a rotation about the third axis.
    calls, covariance = [0], 1e-4 * np.eye(9)
    both = sequence("thigh", np.eye(3)).pose
    assert both is not None
    narrow = counted(
        JointCoordinates(
            "thigh", ("a", "b"), (True, True), lambda v: both(np.pad(v, ((0, 0), (0, 1))))
        ),
        calls,
    )
    tracker = CoordinateTracker(BALL, (default_coordinates(BALL)[0], narrow))
    impossible = both(np.array([[0.3, 0.2, 1.5]]))[0][0]
    for _ in range(20):
        calls[0] = 0
        values, spread = tracker.read(ball_state(impossible), covariance)
        assert calls[0] <= MOST_STEPS
        assert np.isnan(values[6:]).all()
        assert np.isnan(spread[6:]).all()
        assert np.isnan(spread[:, 6:]).all()
        assert np.isfinite(spread[:6, :6]).all()
    possible = both(np.array([[0.3, 0.2, 0.0]]))[0][0]
    found = [tracker.read(ball_state(possible), covariance)[0][6:] for _ in range(6)]
    np.testing.assert_allclose(found[-1], [0.3, 0.2], atol=RESOLUTION)


def test_angles_pass_a_gimbal_lock_without_a_jump() -> None:
    tracker, last = CoordinateTracker(BALL, COORDINATES[:2]), None
    for k in range(101):
        second = 0.5 * np.pi - 0.02 + 4e-4 * k  # the angle increases to the gimbal lock and beyond
        A = exp_matrix(np.array([0.3, 0.0, 0.0])) @ exp_matrix(np.array([0.0, second, 0.0]))
        values, _ = tracker.read(ball_state(A), 1e-4 * np.eye(9))
        if k <= 50:
            assert values[6:] == pytest.approx([0.3, second, 0.0], abs=2e-3)
        assert np.isfinite(values).all()
        last = values
    assert last is not None
    assert abs(last[7]) < 0.5 * np.pi
