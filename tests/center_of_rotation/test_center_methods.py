"""All estimators, called by name, find the same center, refuse the same data and return no NaN."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from bench.baselines.circle_theory import circle_rms_bound
from bench.subjects.simulated_joints import (
    CHILD,
    PARENT,
    ball_turns,
    carried,
    covers,
    fan,
    hinge_turns,
    watched,
)
from jointfit_daemon.center_of_rotation import (
    METHODS,
    BodyPoses,
    Movement,
    estimate_center,
)

IN_A_PLANE = sorted(name for name, method in METHODS.items() if method.planar)
IN_SPACE = ["sphere", "running_sphere", "halvorsen", "gamage_lasenby", "score"]
CENTER = np.array([0.02, -0.3, 0.5])
ANGLES = np.linspace(0.0, np.radians(60.0), 100)


def planar() -> Movement:
    rng = np.random.default_rng(1)
    return Movement(CENTER[:2] + fan(60.0) + rng.normal(0, 1e-3, (100, 4, 2)), angles=ANGLES)


def whole(kind: str) -> Movement:
    rng = np.random.default_rng(2)
    turns = ball_turns(rng, 60.0) if kind == "ball" else hinge_turns(60.0, axis=0)
    seen = watched(rng, turns)
    angles = np.linspace(-0.5, 0.5, len(turns)) * np.radians(60.0)
    return Movement(seen.points, seen.parent, seen.child, angles=angles, near=np.zeros(3))


@pytest.mark.parametrize("name", IN_A_PLANE)
def test_every_planar_method_finds_the_center(name: str) -> None:
    found = estimate_center(planar(), name)
    assert found.refused is None
    assert found.method == name
    tolerance = 0.01 if name in {"grid", "three_frames"} else 0.003
    assert np.linalg.norm(found.center - CENTER[:2]) < tolerance
    assert 0.0 < found.bound < inf
    assert found.arc == pytest.approx(np.radians(60.0), rel=0.15)


@pytest.mark.parametrize("name", [name for name in IN_A_PLANE if name != "oriented"])
def test_bound_belongs_to_the_movement_not_to_the_method(name: str) -> None:
    rng = np.random.default_rng(5)
    noise = lfilter([np.sqrt(1.0 - 0.9**2)], [1.0, -0.9], rng.normal(0, 1e-3, (500, 2)), axis=0)
    turns = np.linspace(0.0, np.radians(70.0), 500)
    points = 0.15 * np.stack((np.cos(turns), np.sin(turns)), axis=1) + noise
    found = estimate_center(Movement(points[:, None]), name)
    assert found.refused is None
    # The errors of the methods differ by a factor of ten here, but the estimated noise hardly
    # differs.
    least = circle_rms_bound(turns, found.noise)
    assert found.bound == pytest.approx(least, rel=0.15)


@pytest.mark.parametrize("name", IN_A_PLANE)
def test_planar_methods_of_a_hinge_in_space_report_the_unseen_axis(name: str) -> None:
    found = estimate_center(whole("hinge"), name)
    assert found.refused is None
    assert found.rms_error == inf
    assert found.axis is not None
    assert abs(found.axis[0]) > 0.999
    off = found.center - found.axis * (found.axis @ found.center)
    assert np.linalg.norm(off) < (0.02 if name in {"grid", "three_frames"} else 0.008)


@pytest.mark.parametrize("name", [name for name in IN_A_PLANE if name != "running_sphere"])
def test_planar_methods_refuse_a_ball_joint(name: str) -> None:
    found = estimate_center(whole("ball"), name)
    assert found.refused is not None
    assert "more than one axis" in found.refused


@pytest.mark.parametrize("name", IN_SPACE)
def test_every_spatial_method_finds_a_ball_joint(name: str) -> None:
    found = estimate_center(whole("ball"), name)
    assert found.refused is None
    assert np.linalg.norm(found.center) < 4e-3
    assert found.bound < inf


@pytest.mark.parametrize("name", ["sphere", "running_sphere", "score", "sara"])
def test_spatial_methods_detect_a_hinge(name: str) -> None:
    found = estimate_center(whole("hinge"), name)
    assert found.refused is None
    assert found.rms_error == inf == found.bound
    assert found.axis is not None
    assert abs(found.axis[0]) > 0.999
    assert np.linalg.norm(found.center) < 6e-3


@pytest.mark.parametrize("name", ["halvorsen", "gamage_lasenby"])
def test_linear_sphere_fits_refuse_a_hinge(name: str) -> None:
    found = estimate_center(whole("hinge"), name)
    assert found.refused is not None
    assert "one axis" in found.refused


def test_auto_selects_a_method_for_the_given_data() -> None:
    ball = whole("ball")
    assert estimate_center(ball).method == "sphere"
    both = replace(ball, parent_markers=PARENT)
    assert estimate_center(both).method == "score"
    assert estimate_center(replace(both, child_markers=CHILD[:2])).method == "sphere"
    line = np.linspace(0.0, 0.1, 4)[:, None] * np.ones(3)
    assert estimate_center(replace(both, child_markers=line)).method == "sphere"
    markers_only = replace(both, child_markers=CHILD, parent=None, child=None)
    assert estimate_center(markers_only).method == "sphere"
    assert estimate_center(Movement(parent=ball.parent, child=ball.child)).method == "score"
    assert estimate_center(planar()).method == "geometric"
    assert estimate_center(planar().points[:, 0]).method == "geometric"  # type: ignore[index]  # it has points


def test_estimate_center_raises_for_invalid_arguments() -> None:
    with pytest.raises(ValueError, match=r"no method 'kaasa'; there are: .*kasa"):
        estimate_center(planar(), "kaasa")
    with pytest.raises(ValueError, match="needs parent and child"):
        estimate_center(planar(), "score")
    with pytest.raises(ValueError, match="needs angles"):
        estimate_center(fan(60.0), "oriented")
    with pytest.raises(ValueError, match="points in space"):
        estimate_center(fan(60.0), "sphere")
    with pytest.raises(ValueError, match="expected"):
        estimate_center(np.zeros(3))


@pytest.mark.parametrize("name", [n for n, m in METHODS.items() if m.needs == ("points",)])
@pytest.mark.parametrize("kind", ["hidden", "still", "line", "few", "two places"])
def test_points_without_a_center_are_refused_by_every_method(name: str, kind: str) -> None:
    d = 2 if METHODS[name].planar else 3
    line = np.linspace(0.0, 0.2, 100)[:, None, None] * np.ones((1, 2, d))
    points = {
        "hidden": np.full((100, 2, d), np.nan),
        "still": np.ones((100, 2, d)),
        "line": line,
        "few": line[:2],
        "two places": np.round(line / 0.2),
    }[kind]
    angles = np.linspace(0.0, 1.0, len(points))
    found = estimate_center(Movement(points, angles=angles), name)
    assert found.refused is not None
    assert len(found.refused) > 25
    assert found.rms_error == inf


@pytest.mark.parametrize("name", ["sphere", "running_sphere", "geometric", "score", "sara"])
def test_a_marker_that_jumps_moves_no_robust_method_far(name: str) -> None:
    movement = whole("hinge" if name in {"geometric", "sara"} else "ball")
    assert movement.points is not None
    assert movement.child is not None
    points, t = movement.points.copy(), movement.child.t.copy()
    points[30:200:17, 1] += 0.08
    t[30:200:17] += 0.05
    jumped = replace(movement, points=points, child=BodyPoses(movement.child.q, t))
    before, after = (estimate_center(m, name) for m in (movement, jumped))
    assert after.refused is None
    assert np.linalg.norm(after.center - before.center) < 5e-3


@given(st.integers(0, 1000), st.floats(0.0, 0.9), st.sampled_from([*IN_SPACE, "sara"]))
@settings(max_examples=40, deadline=None)
def test_no_method_returns_nan_without_a_refusal(seed: int, hidden: float, name: str) -> None:
    rng = np.random.default_rng(seed)
    rom = float(rng.choice([1.0, 20.0, 120.0]))
    turns = ball_turns(rng, rom, 60) if rng.integers(2) else hinge_turns(rom, 60)
    seen = watched(rng, turns, noise=float(rng.choice([1e-6, 1e-3, 3e-2])))
    points = seen.points.copy()
    points[rng.uniform(size=points.shape[:2]) < hidden] = np.nan
    found = estimate_center(Movement(points, seen.parent, seen.child), name)
    if found.refused is None:
        assert np.isfinite(found.center).all()
        assert np.isfinite(found.covariance).all()
        assert not np.isnan([found.rms_error, found.noise, found.bound, found.arc]).any()


@pytest.mark.parametrize("arc", [20.0, 45.0, 90.0])
def test_the_batch_spheres_ellipse_covers(arc: float) -> None:
    """The 95 % ellipsoid contains the true center in at least 70 of 80 movements."""
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(80):
        paths = carried(ball_turns(rng, arc))
        found = estimate_center(paths + rng.normal(0, 1e-3, paths.shape), "sphere")
        assert found.refused is None
        held += covers(found)
    assert held >= 70


def test_three_frames_predict_their_error_from_the_residuals_of_the_cameras() -> None:
    rng, angles = np.random.default_rng(5), np.linspace(0.0, np.radians(100.0), 60)
    occluded = np.abs(np.abs(angles - angles.mean()) - np.radians(25.0)) < np.radians(12.0)
    sd = np.where(occluded, 2e-3, 0.5e-3)  # small at both ends and in the middle of the arc
    circle = 0.3 * np.stack((np.cos(angles), np.sin(angles)), axis=-1)[:, None]
    errors, stated, unstated = [], [], []
    for _ in range(200):
        points = circle + sd[:, None, None] * rng.normal(size=circle.shape)
        found = estimate_center(Movement(points, residuals=0.3 * sd[:, None]), "three_frames")
        errors.append(found.center)
        stated.append(found.rms_error**2)
        unstated.append(estimate_center(Movement(points), "three_frames").rms_error ** 2)
    actual = np.mean(np.sum(np.square(errors), axis=1))
    assert np.sqrt(np.mean(stated) / actual) == pytest.approx(1.0, abs=0.1)
    assert np.sqrt(np.mean(unstated) / actual) > 1.5


def test_a_noisy_marker_is_flagged_by_its_name_if_another_marker_is_missing() -> None:
    rng = np.random.default_rng(7)
    points = carried(ball_turns(rng, 45.0, 300))
    points = points + rng.normal(0.0, 1e-3, points.shape)
    points[:, 0] = np.nan
    points[:, 2] += rng.normal(0.0, 0.02, (300, 3))
    unnamed, named = (
        estimate_center(Movement(points, names=names), "running_sphere")
        for names in (None, ("C1", "C2", "C3", "C4"))
    )
    assert "noisy_marker:2" in unnamed.flags
    assert "noisy_marker:C3" in named.flags
