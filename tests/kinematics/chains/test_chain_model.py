"""Chain models: rejection of invalid chains, Jacobian, steps and scaling."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.chains import (
    ChainModel,
    ChainState,
    InvalidChainModelError,
    Joint,
    Marker,
    Sample,
    Segment,
    apply_step,
    exp_matrix,
    jacobian,
    marker_positions,
    rest_state,
    segment_poses,
    step_between,
)
from tests.kinematics.chain_coordinates import hinge_angles


def winding(rng: np.random.Generator, count: int = 12) -> tuple[Sample, ...]:
    """Return samples of a coupled joint that rotates about and translates along all axes."""
    amounts = np.linspace(-2.0, 2.5, count)
    ways = rng.normal(0.0, 0.5, (6, 3)) @ np.array([amounts, np.sin(amounts), amounts**2 / 4.0])
    turns = rotation.exp(ways[:3].T) * rng.choice([-1.0, 1.0], (count, 1))
    return tuple(map(tuple, np.column_stack((amounts, turns, 0.1 * ways[3:].T)).tolist()))


def random_chain(rng: np.random.Generator) -> ChainModel:
    """Return a tree of up to six segments with joints of all kinds, one or two roots."""
    segments: list[Segment] = []
    for i in range(int(rng.integers(1, 7))):
        axis = rng.normal(size=3)
        kind = rng.choice(["ball", "hinge", "coupled"]) if i else "free"
        if i == 3 and rng.random() < 0.3:
            kind = "free"
        joint = Joint(
            str(kind),  # type: ignore[arg-type]
            tuple(rng.normal(0.0, 0.3, 3).tolist()),
            tuple(rng.normal(0.0, 0.1, 3).tolist()),
            tuple((axis / np.linalg.norm(axis)).tolist()),
            tuple(rotation.normalize(rng.normal(size=4)).tolist()),
            path=winding(rng) if kind == "coupled" else (),
        )
        parent = None if kind == "free" else f"s{rng.integers(i)}"
        segments.append(Segment(f"s{i}", parent, joint))
    markers = (
        Marker(f"{s.name}_{k}", s.name, tuple(rng.normal(0.0, 0.1, 3).tolist()))
        for s in segments
        for k in range(int(rng.integers(0, 5)))
    )
    return ChainModel(tuple(segments), tuple(markers))


def random_state(model: ChainModel, rng: np.random.Generator, count: int = 3) -> ChainState:
    return apply_step(model, rest_state(model, count), rng.normal(0.0, 1.0, (count, model.nq)))


seeds = st.integers(0, 2**32 - 1)


@given(seeds)
@settings(max_examples=40)
def test_the_jacobian_is_the_slope_of_the_markers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = random_chain(rng)
    state = random_state(model, rng)
    J, h = jacobian(model, state), 1e-6
    assert J.shape == (3, len(model.markers), 3, model.nq)
    for k in range(model.nq):
        step = np.zeros((3, model.nq))
        step[:, k] = h
        ahead = marker_positions(model, apply_step(model, state, step))
        behind = marker_positions(model, apply_step(model, state, -step))
        np.testing.assert_allclose(J[..., k], (ahead - behind) / (2 * h), atol=1e-8)


def coupled_shifts(model: ChainModel, couplings: np.ndarray) -> dict[str, np.ndarray]:
    coupled = [s.name for s in model.segments if s.joint.kind == "coupled"]
    return {name: couplings[:, c, 1:4] for c, name in enumerate(coupled)}


@given(seeds)
@settings(max_examples=30)
def test_a_joint_center_is_the_same_point_on_both_segments(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = random_chain(rng)
    state = random_state(model, rng)
    R, t = segment_poses(model, state)
    shifts = {} if state.couplings is None else coupled_shifts(model, state.couplings)
    for i, segment in enumerate(model.segments):
        if segment.parent is None:
            continue
        p = model.parents[i]
        center = np.array(segment.joint.center_in_parent) + shifts.get(segment.name, 0.0)
        above = t[:, p] + (R[:, p] @ np.broadcast_to(center, (3, 3))[..., None])[..., 0]
        own = t[:, i] + R[:, i] @ np.array(segment.joint.center)
        np.testing.assert_allclose(above, own, atol=1e-12)


@given(seeds)
@settings(max_examples=30)
def test_the_step_between_two_states_leads_from_one_to_the_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = random_chain(rng)
    a, b = random_state(model, rng), random_state(model, rng)
    there = apply_step(model, a, step_between(model, a, b))
    np.testing.assert_allclose(there.rotations, b.rotations, atol=1e-9)
    np.testing.assert_allclose(there.origins, b.origins, atol=1e-12)


@given(st.lists(st.floats(-10.0, 10.0), min_size=3, max_size=3))
def test_the_matrix_of_a_rotation_vector_is_that_of_its_quaternion(vector: list[float]) -> None:
    expected = rotation.to_matrix(rotation.exp(vector))
    np.testing.assert_allclose(exp_matrix(np.array(vector)), expected, atol=1e-12)


def test_a_hinge_turns_about_its_axis_from_its_rest() -> None:
    rest = tuple(rotation.exp([0.3, -0.2, 0.1]).tolist())
    knee = Joint("hinge", (0.0, 0.0, -0.4), axis=(0.0, 0.6, 0.8), rest=rest)
    model = ChainModel((Segment("thigh"), Segment("shank", "thigh", knee)), ())
    state = apply_step(model, rest_state(model), np.array([[0.0] * 6 + [0.7]]))
    q = rotation.multiply(rest, rotation.exp([0.0, 0.42, 0.56]))
    np.testing.assert_allclose(state.rotations[0, 1], rotation.to_matrix(q), atol=1e-12)
    np.testing.assert_allclose(hinge_angles(model, state)["shank"], [0.7], atol=1e-12)


def test_scaling_a_segment_stretches_all_that_is_fixed_to_it() -> None:
    knee = Joint("ball", (0.0, 0.0, -0.4), (0.0, 0.0, 0.02))
    model = ChainModel(
        (Segment("thigh"), Segment("shank", "thigh", knee)),
        (Marker("a", "thigh", (0.1, 0.0, 0.2)), Marker("b", "shank", (0.1, 0.0, 0.2))),
    )
    scaled = model.scaled({"thigh": (2.0, 1.0, 1.5)})
    assert scaled.segments[1].joint.center_in_parent == pytest.approx((0.0, 0.0, -0.6))
    assert scaled.segments[1].joint.center == knee.center
    assert scaled.markers[0].position == pytest.approx((0.2, 0.0, 0.3))
    assert scaled.markers[1].position == (0.1, 0.0, 0.2)
    with pytest.raises(InvalidChainModelError, match="shin"):
        model.scaled({"shin": 1.1})


def test_markers_moved_or_locked_are_another_model() -> None:
    model = ChainModel((Segment("a"),), (Marker("m", "a", (0.0, 0.0, 0.0)),))
    assert model.with_markers([[1.0, 2.0, 3.0]]).markers[0].position == (1.0, 2.0, 3.0)
    locked = model.with_locks({"m": (True, False, True)})
    assert locked.locked.tolist() == [[True, False, True]]
    assert model.positions.tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.parametrize(
    ("segments", "markers", "said"),
    [
        ((), (), "no segments"),
        ((Segment("a"), Segment("a")), (), "'a' twice"),
        ((Segment("a", "b", Joint("ball")), Segment("b")), (), "'b' is after it"),
        ((Segment("a", "c", Joint("ball")),), (), "'c' is unknown"),
        ((Segment("a"), Segment("b", "a")), (), "a free joint must not have a parent"),
        ((Segment("a", None, Joint("hinge", axis=(1.0, 1.0, 0.0))),), (), "not of length 1"),
        ((Segment("a", None, Joint("hinge", limits=(1.0, 0.0))),), (), "lower limit below the"),
        ((Segment("a"),), (Marker("m", "b", (0.0, 0.0, 0.0)),), "no segment 'b'"),
        ((Segment("a"),), (Marker("m", "a", (0.0, float("nan"), 0.0)),), "not finite"),
        ((Segment("a"),), (Marker("m", "a", (0.0, 0.0, 0.0), -1.0),), "weight -1.0"),
    ],
)
def test_invalid_chains_are_rejected_by_name(
    segments: tuple[Segment, ...], markers: tuple[Marker, ...], said: str
) -> None:
    with pytest.raises(InvalidChainModelError, match=said):
        ChainModel(segments, markers)
