"""Coordinates of one instant after the other equal those of the whole trial."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_daemon.kinematics.chain_coordinates import (
    CoordinateTracker,
    JointCoordinates,
    coordinate_table,
    default_coordinates,
)
from jointfit_daemon.kinematics.chains import (
    ChainModel,
    Joint,
    Segment,
    apply_step,
    rest_state,
)

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
        return  # near a gimbal lock the angles amplify any difference
    values, sd = CoordinateTracker(MODEL, COORDINATES).read(state, covariance)
    np.testing.assert_allclose(values, table.values[0], atol=RESOLUTION)
    np.testing.assert_allclose(sd, table.sd[0], rtol=5e-3)


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
        values, sd = tracker.read(state, covariance)
        assert values[-2:] == pytest.approx([0.5 * np.sin(0.1 * k), 0.0], abs=0.05)
        assert np.isfinite(sd).all()
