"""Coupled joints, whose rotation and translation depend on one coordinate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from jointfit_daemon.kinematics.chains import (
    ChainModel,
    CoupledCurve,
    InvalidChainModelError,
    Joint,
    Marker,
    Sample,
    Segment,
    apply_step,
    jacobian,
    marker_positions,
    rest_state,
    step_between,
)
from jointfit_daemon.kinematics.inverse_kinematics import (
    IkOptions,
    LiveInverseKinematics,
    marker_fit,
    marker_slots,
    solve_frames,
)
from jointfit_daemon.kinematics.inverse_kinematics._normal_equations import normal_equations
from tests.kinematics.chain_coordinates import coupled_coordinates

BENT = np.linspace(-0.3, 2.3, 40)


def knee_pose(amounts: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """Return rotations and translations, m, of a knee, as functions of its flexion."""
    a = np.asarray(amounts)
    turned = np.stack((-a, 0.2 * np.sin(a), 0.15 * (1.0 - np.cos(a))), axis=-1)
    shift = np.stack((0.002 * a, -0.02 * np.sin(a), 0.01 * a * a), axis=-1)
    return Rotation.from_euler("XYZ", turned), shift


def samples(count: int = 41) -> tuple[Sample, ...]:
    amounts = np.linspace(-0.4, 2.5, count)
    turns, shift = knee_pose(amounts)
    wxyz = turns.as_quat()[:, [3, 0, 1, 2]]
    return tuple(map(tuple, np.column_stack((amounts, wxyz, shift)).tolist()))


def leg(seed: int = 0) -> ChainModel:
    rng = np.random.default_rng(seed)
    knee = Joint("coupled", (0.01, 0.0, -0.4), (0.0, 0.02, 0.01), limits=(0.0, 2.1), path=samples())
    segments = (
        Segment("thigh"),
        Segment("shank", "thigh", knee),
        Segment("foot", "shank", Joint("ball", (0.0, 0.0, -0.4))),
    )
    return ChainModel(
        segments,
        tuple(
            Marker(f"{s.name}{k}", s.name, tuple((rng.normal(0, 0.08, 3) - [0, 0, 0.15]).tolist()))
            for s in segments
            for k in range(4)
        ),
    )


def squat(model: ChainModel, amounts: np.ndarray = BENT) -> np.ndarray:
    step = np.zeros((len(amounts), model.nq))
    step[:, 2], step[:, 4], step[:, 6] = 2.0, 0.3 * amounts, amounts
    step[:, 7] = 0.3 * amounts
    return step


def test_a_curve_interpolates_its_samples() -> None:
    curve = CoupledCurve.through(samples())
    at = np.array([s[0] for s in samples()])
    R, found = curve.at(at)
    np.testing.assert_allclose(R, knee_pose(at)[0].as_matrix(), atol=1e-12)
    np.testing.assert_allclose(found[:, 1:4], knee_pose(at)[1], atol=1e-12)
    between = np.linspace(-0.39, 2.49, 97)
    R, found = curve.at(between)
    np.testing.assert_allclose(R, knee_pose(between)[0].as_matrix(), atol=2e-6)
    np.testing.assert_allclose(found[:, 1:4], knee_pose(between)[1], atol=1e-6)
    np.testing.assert_array_equal(found[:, 0], between)


@given(st.floats(-3.0, 5.0))
@settings(max_examples=60)
def test_the_twist_of_a_curve_is_its_derivative(amount: float) -> None:
    curve, h = CoupledCurve.through(samples()), 1e-5
    R, found = curve.at(np.array([amount, amount - h, amount + h]))
    turned = Rotation.from_matrix(R[1].T @ R[2]).as_rotvec() / (2.0 * h)
    np.testing.assert_allclose(found[0, 4:7], turned, atol=1e-5)
    slid = R[0].T @ (found[2, 1:4] - found[1, 1:4]) / (2.0 * h)
    np.testing.assert_allclose(found[0, 7:], slid, atol=1e-5)


@given(st.floats(-3.0, 5.0))
@settings(max_examples=60)
def test_one_instant_equals_the_same_instant_of_a_trial(amount: float) -> None:
    curve = CoupledCurve.through(samples())
    alone, among = curve.at(np.array([amount])), curve.at(np.array([0.1, amount]))
    np.testing.assert_allclose(alone[0][0], among[0][1], atol=1e-12)
    np.testing.assert_allclose(alone[1][0], among[1][1], atol=1e-12)


def test_the_signs_of_quaternions_do_not_matter() -> None:
    flipped = [
        (s[0], *(-x for x in s[1:5]), *s[5:]) if i % 3 else s for i, s in enumerate(samples())
    ]
    amounts = np.linspace(-0.4, 2.5, 50)
    for mine, other in zip(
        CoupledCurve.through(samples()).at(amounts),
        CoupledCurve.through(flipped).at(amounts),
        strict=True,
    ):
        np.testing.assert_allclose(mine, other, atol=1e-12)


def test_markers_follow_the_joint_as_in_an_independent_computation() -> None:
    model = leg()
    state = apply_step(model, rest_state(model, len(BENT)), squat(model))
    joint = model.segments[1].joint
    A, shift = knee_pose(BENT)
    thigh = state.rotations[:, 0]
    center = np.array(joint.center_in_parent) + shift
    local = A.as_matrix() @ (np.array(model.markers[5].position) - joint.center) + center
    expected = state.origins[:, 0] + (thigh @ local[..., None])[..., 0]
    np.testing.assert_allclose(marker_positions(model, state)[:, 5], expected, atol=1e-5)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_sums_over_segments_are_the_dense_normal_equations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = leg(seed)
    state = apply_step(model, rest_state(model, 3), rng.normal(0.0, 1.0, (3, model.nq)))
    y = marker_positions(model, state) + rng.normal(0.0, 0.1, (3, len(model.markers), 3))
    w = rng.uniform(0.0, 2.0, y.shape[:2])
    slots = marker_slots(model)
    H, g = normal_equations(
        slots, marker_fit(slots, state, slots.vectors_to_slots(y), slots.to_slots(w))
    )
    J, e = jacobian(model, state), marker_positions(model, state) - y
    np.testing.assert_allclose(H, np.einsum("tmik,tm,tmil->tkl", J, w, J), atol=1e-9)
    np.testing.assert_allclose(g, np.einsum("tmik,tm,tmi->tk", J, w, e), atol=1e-9)


def test_true_markers_determine_the_coordinate_without_a_start() -> None:
    model = leg()
    truth = apply_step(model, rest_state(model, len(BENT)), squat(model))
    found = solve_frames(model, marker_positions(model, truth))
    assert found.converged.all()
    np.testing.assert_allclose(step_between(model, truth, found.state), 0.0, atol=1e-7)
    np.testing.assert_allclose(coupled_coordinates(model, found.state)["shank"], BENT, atol=1e-7)


def test_a_coordinate_stays_within_limits_that_have_a_weight() -> None:
    model = leg()
    beyond = np.array([-0.3, 1.0, 2.3])
    y = marker_positions(model, apply_step(model, rest_state(model, 3), squat(model, beyond)))
    held = solve_frames(model, y, options=IkOptions(limit_m2=100.0)).state
    np.testing.assert_allclose(
        coupled_coordinates(model, held)["shank"], [0.0, 1.0, 2.1], atol=0.01
    )


def test_limits_count_from_zero_even_if_samples_start_above() -> None:
    model = leg()
    knee = replace(model.segments[1].joint, path=samples()[10:], limits=(0.5, 2.1))
    shank = replace(model.segments[1], joint=knee)
    model = replace(model, segments=(model.segments[0], shank, model.segments[2]))
    assert coupled_coordinates(model, rest_state(model))["shank"] == pytest.approx([0.325])
    y = marker_positions(model, rest_state(model))
    held = solve_frames(model, y, options=IkOptions(limit_m2=100.0)).state
    assert coupled_coordinates(model, held)["shank"] == pytest.approx([0.5], abs=0.01)


def test_an_undetermined_coordinate_is_held_at_the_instant_before() -> None:
    model = leg()
    truth = apply_step(model, rest_state(model, 5), squat(model, np.linspace(1.0, 1.1, 5)))
    y = marker_positions(model, truth)
    y[3, 4:] = np.nan
    found = solve_frames(model, y)
    assert found.underdetermined.tolist() == [False, False, False, True, False]
    knee = coupled_coordinates(model, found.state)["shank"]
    assert knee[3] == pytest.approx(knee[2], abs=1e-6)


def test_a_movement_is_followed_live_with_its_covariance() -> None:
    model = leg()
    bent = 1.0 + 0.9 * np.sin(np.linspace(0.0, 6.0, 200))
    truth = apply_step(model, rest_state(model, 200), squat(model, bent))
    noise = np.random.default_rng(1).normal(0.0, 0.001, (200, len(model.markers), 3))
    live = LiveInverseKinematics(model)
    poses = [live.feed(row) for row in marker_positions(model, truth) + noise]
    assert not any(p.restarted for p in poses[1:])
    off = np.array(
        [step_between(model, truth.take(slice(i, i + 1)), p.state)[0] for i, p in enumerate(poses)]
    )
    assert np.sqrt(np.mean(off[20:, 6] ** 2)) < 0.01
    told = np.mean([p.covariance[6, 6] for p in poses[100:]])
    assert np.mean(off[100:, 6] ** 2) == pytest.approx(told, rel=0.5)


def test_scaling_the_parent_stretches_the_way_of_the_center() -> None:
    """The path of the joint center is scaled with the parent segment."""
    model = leg().scaled({"thigh": (1.0, 2.0, 3.0)})
    old, new = leg().segments[1].joint, model.segments[1].joint
    assert np.array(new.path)[:, 5:] == pytest.approx(np.array(old.path)[:, 5:] * [1, 2, 3])
    np.testing.assert_array_equal(np.array(new.path)[:, :5], np.array(old.path)[:, :5])


@pytest.mark.parametrize(
    ("joint", "said"),
    [
        (Joint("coupled"), "needs a path of 4 samples, has 0"),
        (Joint("hinge", path=samples()), "a path, but its joint is 'hinge'"),
        (Joint("coupled", path=samples()[::-1]), "must increase"),
        (Joint("coupled", path=((0, 1, 1, 0, 0, 0, 0, 0), *samples()[9:12])), "not of length 1"),
        (Joint("coupled", path=((-1, 1, 0, 0, 0, 0, 0, np.inf), *samples()[:3])), "not finite"),
    ],
)
def test_invalid_paths_are_rejected(joint: Joint, said: str) -> None:
    with pytest.raises(InvalidChainModelError, match=said):
        ChainModel((Segment("thigh"), Segment("shank", "thigh", joint)), ())


def test_few_samples_are_joined_smoothly() -> None:
    few = samples(6)
    spline = CubicSpline([s[0] for s in few], [s[5:] for s in few])
    amounts = np.linspace(-0.4, 2.5, 30)
    found = CoupledCurve.through(few).at(amounts)[1]
    np.testing.assert_allclose(found[:, 1:4], spline(amounts), atol=1e-12)
