"""Named coordinates of a chain: inverse of the joint functions, and their standard deviations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_daemon.files.models import read_osim
from jointfit_daemon.kinematics.chain_coordinates import (
    JointCoordinates,
    coordinate_table,
    default_coordinates,
)
from jointfit_daemon.kinematics.chains import (
    ChainModel,
    ChainState,
    Joint,
    Marker,
    Segment,
    apply_step,
    marker_positions,
    place_coupled,
    rest_state,
)
from jointfit_daemon.kinematics.chains import layout_of as layout
from jointfit_daemon.kinematics.inverse_kinematics import pose_covariance, solve_frames
from tests.files.models.osim_writer import LINEAR, ZERO, Hung, write_osim

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

SEGMENTS = (
    Segment("pelvis"),
    Segment("thigh", "pelvis", Joint("ball", (0.1, 0.0, -0.1))),
    Segment("shank", "thigh", Joint("hinge", (0.0, 0.0, -0.4), rest=(0.8, 0.0, 0.6, 0.0))),
)
MARKERS = tuple(
    Marker(f"{s.name}{k}", s.name, tuple(at))
    for s in SEGMENTS
    for k, at in enumerate(np.random.default_rng(3).normal(0.0, 0.1, (4, 3)).tolist())
)
MODEL = ChainModel(SEGMENTS, MARKERS, "leg")


def state_of(
    model: ChainModel, coordinates: tuple[JointCoordinates, ...], values: Array
) -> ChainState:
    """Return the state with given coordinates, shape (T, K)."""
    rotations, origins, at = [], [], 0
    for joint, segment in zip(coordinates, model.segments, strict=True):
        assert joint.pose is not None
        A, t = joint.pose(values[:, at : at + len(joint.names)])
        rotations.append(A)
        origins += [t] if segment.joint.kind == "free" else []
        at += len(joint.names)
    placed = np.stack(origins, axis=1)
    return place_coupled(layout(model), np.stack(rotations, axis=1), placed, None)


def no_covariance(model: ChainModel, count: int) -> Array:
    return np.zeros((count, model.nq, model.nq))


@settings(max_examples=15, deadline=None)
@given(
    st.lists(st.floats(-3.1, 3.1), min_size=5, max_size=5),
    st.tuples(st.floats(-1.4, 1.4), st.floats(-1.4, 1.4)),
    st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3),
)
def test_coordinates_of_a_pose_are_those_it_was_made_of(
    outer: list[float], middle: tuple[float, float], place: list[float]
) -> None:
    a, b, c, d, knee = outer
    values = np.array([[a, middle[0], b, *place, c, middle[1], d, knee]])
    coordinates = default_coordinates(MODEL)
    state = state_of(MODEL, coordinates, values)
    found = coordinate_table(MODEL, state, no_covariance(MODEL, 1), coordinates)
    assert found.names[0] == "pelvis_rx"
    assert found.names[-1] == "shank_angle"
    np.testing.assert_allclose(found.values, values, atol=1e-7)
    assert max(found.misfit.values()) < 1e-7


def test_angles_are_continuous_beyond_180_degrees() -> None:
    turned = np.zeros((50, 10))
    turned[:, 2] = np.linspace(2.0, 5.0, 50)
    coordinates = default_coordinates(MODEL)
    state = state_of(MODEL, coordinates, turned)
    found = coordinate_table(MODEL, state, no_covariance(MODEL, 50), coordinates)
    assert np.abs(np.diff(found.values[:, 2])).max() < 0.1


def test_angles_are_continuous_over_known_instants_only() -> None:
    turned = np.zeros((50, 10))
    turned[:, 2] = 0.5
    turned[20:30, 2] = np.linspace(2.5, 5.7, 10)  # continues to the next full turn
    turned[30:, 2] = 0.5 + 2.0 * np.pi
    coordinates = default_coordinates(MODEL)
    known = np.ones((50, 10), np.bool_)
    known[20:30, 2] = False
    state = state_of(MODEL, coordinates, turned)
    found = coordinate_table(MODEL, state, no_covariance(MODEL, 50), coordinates, known)
    np.testing.assert_allclose(np.delete(found.values[:, 2], np.s_[20:30]), 0.5, atol=1e-7)


def test_a_table_without_known_instants_has_values() -> None:
    coordinates = default_coordinates(MODEL)
    state = state_of(MODEL, coordinates, np.full((3, 10), 0.2))
    known = np.zeros((3, 10), np.bool_)
    found = coordinate_table(MODEL, state, no_covariance(MODEL, 3), coordinates, known)
    np.testing.assert_allclose(found.values, 0.2, atol=1e-7)


@pytest.mark.parametrize("kind", ["SliderJoint", "CustomJoint"])
def test_a_segment_that_only_slides_has_its_translations(tmp_path: Path, kind: str) -> None:
    names = ["x"] if kind == "SliderJoint" else ["x", "y", "z"]
    unit = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    fixed = [("", axis, ZERO) for axis in unit]
    moving = [(name, axis, LINEAR) for name, axis in zip(names, unit, strict=False)]
    sliding = Hung(
        "base",
        "ground",
        kind,
        [(name, -9.0, 9.0) for name in names],
        axes=[*fixed, *moving] if kind == "CustomJoint" else [],
    )
    markers = [(f"m{k}", "base", axis, False) for k, axis in enumerate(unit)]
    read = read_osim(write_osim(tmp_path / "m.osim", [sliding], markers))
    assert read.coordinates[0].names == tuple(names)
    values = np.random.default_rng(2).uniform(-2.0, 2.0, (5, len(names)))
    state = state_of(read.model, read.coordinates, values)
    found = coordinate_table(read.model, state, no_covariance(read.model, 5), read.coordinates)
    np.testing.assert_allclose(found.values, values, atol=1e-9)
    assert found.misfit["base"] < 1e-9


def test_oblique_axes_of_an_opensim_joint_are_inverted(tmp_path: Path) -> None:
    root = Hung("base", "ground", "FreeJoint", [(f"c{k}", -9.0, 9.0) for k in range(6)])
    axes = ((0.9, 0.1, 0.3), (0.2, 1.0, 0.0), (0.0, -0.3, 0.9))
    oblique = Hung(
        "arm",
        "base",
        "CustomJoint",
        [("third", -1.0, 1.0), ("first", -1.0, 1.0), ("second", -1.0, 1.0)],
        ((0.0, 0.3, 0.0), (0.4, 0.1, 0.0)),
        ((0.0, 0.1, 0.0), (0.0, 0.5, 0.2)),
        [
            *(
                (name, a, LINEAR)
                for name, a in zip(("first", "second", "third"), axes, strict=True)
            ),
            *(("", a, ZERO) for a in axes),
        ],
    )
    places = np.random.default_rng(0).normal(0.0, 0.1, (8, 3)).tolist()
    markers = [
        (f"m{k}", "base" if k < 4 else "arm", tuple(at), False) for k, at in enumerate(places)
    ]
    read = read_osim(write_osim(tmp_path / "m.osim", [root, oblique], markers))
    values = np.random.default_rng(1).uniform(-0.6, 0.6, (30, 9))
    state = state_of(read.model, read.coordinates, values)
    found = coordinate_table(read.model, state, no_covariance(read.model, 30), read.coordinates)
    assert found.names == ("c0", "c1", "c2", "c3", "c4", "c5", "third", "first", "second")
    assert found.is_angle == (True, True, True, False, False, False, True, True, True)
    np.testing.assert_allclose(found.values, values, atol=1e-7)


def test_standard_deviations_are_those_of_repeated_trials() -> None:
    noise, count = 0.003, 600
    coordinates = default_coordinates(MODEL)
    values = np.tile([0.3, -0.5, 0.2, 0.1, 0.2, 0.9, 0.8, 0.9, -0.4, 0.7], (count, 1))
    y = marker_positions(MODEL, state_of(MODEL, coordinates, values))
    y += np.random.default_rng(5).normal(0.0, noise, y.shape)
    found = solve_frames(MODEL, y)
    covariance, determined = pose_covariance(MODEL, found)
    table = coordinate_table(MODEL, found.state, covariance, coordinates)
    assert determined.all()
    np.testing.assert_allclose(table.sd.mean(axis=0), table.values.std(axis=0), rtol=0.12)


def test_coordinates_without_markers_are_undetermined() -> None:
    state = apply_step(MODEL, rest_state(MODEL, 6), np.full((6, MODEL.nq), 0.2))
    y = marker_positions(MODEL, state)
    y[2, 8:] = np.nan  # in one instant no marker of the shank is visible
    _, determined = pose_covariance(MODEL, solve_frames(MODEL, y))
    assert not determined[2, -1]
    assert determined[:, :-1].all()
    assert determined[[0, 1, 3, 4, 5]].all()
