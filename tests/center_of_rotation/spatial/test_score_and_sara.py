"""Centers and axes by SCoRE and SARA, fused estimates, and noise of the parent's frame."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest

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
from jointfit_daemon.center_of_rotation import BodyPoses, fuse_centers
from jointfit_daemon.center_of_rotation._result import refusal
from jointfit_daemon.center_of_rotation.planar import CircleLimits, circle_estimate
from jointfit_daemon.center_of_rotation.spatial import (
    fit_axis,
    fit_running,
    fit_score,
    relative,
    spatial_noise,
)

ANYHOW = CircleLimits(gate=0.0, arc=0.0, rms_error=inf)


def test_score_is_exact_without_noise_and_calibrated_with_noise() -> None:
    rng = np.random.default_rng(1)
    exact = watched(rng, ball_turns(rng, 45), noise=0.0)
    assert np.linalg.norm(fit_score(exact.parent, exact.child).center) < 1e-9
    held = 0
    for _ in range(60):
        seen = watched(rng, ball_turns(rng, 45))
        found = fit_score(seen.parent, seen.child)
        assert found.refused is None
        held += covers(found)
    assert held >= 48


def test_score_tolerates_frames_with_a_wrong_pose() -> None:
    """In 30 frames, the child pose is wrong by 0.3 m per axis, as with exchanged markers."""
    rng = np.random.default_rng(2)
    seen = watched(rng, ball_turns(rng, 60, 300))
    t = seen.child.t.copy()
    t[50:80] += 0.3
    found = fit_score(seen.parent, BodyPoses(seen.child.q, t))
    assert np.linalg.norm(found.center) < 3e-3


def test_a_hinge_is_an_axis_for_both_methods() -> None:
    rng = np.random.default_rng(3)
    seen = watched(rng, hinge_turns(45.0, axis=0))
    for found in (
        fit_axis(seen.parent, seen.child, near=np.zeros(3), toward=np.array([1.0, 0, 0])),
        fit_score(seen.parent, seen.child, near=np.zeros(3)),
    ):
        assert found.rms_error == inf == found.bound
        assert found.axis is not None
        assert abs(found.axis[0]) > 0.999
        assert np.linalg.norm(found.center) < 6e-3
    assert fit_axis(seen.parent, seen.child, toward=np.array([-1.0, 0, 0])).unseen[0, 0] < 0.0


def test_motion_about_two_axes_is_no_hinge() -> None:
    rng = np.random.default_rng(4)
    seen = watched(rng, ball_turns(rng, 60))
    found = fit_axis(seen.parent, seen.child)
    assert found.refused is not None
    assert "more than one axis" in found.refused
    assert "score" in found.refused


def test_score_and_sara_refuse_hidden_and_resting_bodies() -> None:
    rng = np.random.default_rng(5)
    seen = watched(rng, ball_turns(rng, 60))
    hidden = BodyPoses(np.full((200, 4), np.nan), np.full((200, 3), np.nan))
    still = watched(rng, np.tile(np.eye(3), (200, 1, 1)), noise=1e-4)
    for method in (fit_score, fit_axis):
        for parent, child, word in (
            (seen.parent, hidden, "visible"),
            (still.parent, still.child, "move the joint"),
        ):
            found = method(parent, child)
            assert found.refused is not None
            assert word in found.refused


def test_fused_markers_determine_each_others_weak_direction() -> None:
    rng = np.random.default_rng(6)
    seen = fan(20.0) + rng.normal(0, 2e-3, (100, 4, 2))
    single = [circle_estimate(seen[:, j], limits=ANYHOW) for j in range(4)]
    fused = fuse_centers(single)
    assert fused.rms_error < 0.2 * min(estimate.rms_error for estimate in single)
    assert np.linalg.norm(fused.center) < 3.0 * fused.rms_error


def test_a_marker_that_contradicts_the_others_is_named_and_loses_its_weight() -> None:
    rng = np.random.default_rng(7)
    seen = fan(60.0) + rng.normal(0, 1e-3, (100, 4, 2))
    single = [circle_estimate(seen[:, j], limits=ANYHOW) for j in range(4)]
    off = [*single[:3], replace(single[3], center=single[3].center + 0.125)]
    assert np.linalg.norm(fuse_centers(off, robust=False).center) > 5e-3
    fused = fuse_centers(off)
    assert np.linalg.norm(fused.center) < 3e-3
    assert "marker_off:3" in fused.flags


def test_refused_markers_are_left_out_as_long_as_others_remain() -> None:
    good = fit_running(carried(ball_turns(np.random.default_rng(8), 45)))
    bad = refusal("x", 3, 10, "no good: show the markers")
    assert np.allclose(fuse_centers([bad, good]).center, good.center)
    assert fuse_centers([bad, bad]).refused == "no good: show the markers"
    with pytest.raises(ValueError, match="no estimates"):
        fuse_centers([])


def test_a_shared_unseen_direction_stays_unseen() -> None:
    rng = np.random.default_rng(9)
    paths = carried(hinge_turns(60.0, axis=0))
    found = [fit_running((paths + rng.normal(0, 1e-4, paths.shape))[:, [j]]) for j in range(3)]
    # all three estimates get the same axis, like an axis that a user configures
    common = [replace(f, unseen=found[0].unseen, axis=found[0].axis) for f in found]
    fused = fuse_centers(common)
    assert fused.rms_error == inf
    assert fused.axis is not None
    assert abs(fused.axis[0]) > 0.999


def test_parents_that_define_no_frame_are_refused() -> None:
    line = np.linspace(0, 1, 4)[:, None] * np.ones(3)
    with pytest.raises(ValueError, match="not on a line"):
        spatial_noise(CHILD[0], line, 1e-3)


def test_the_known_noise_of_the_parent_reduces_the_bias() -> None:
    rng = np.random.default_rng(11)
    aside = 0.3 * PARENT + np.array([0.25, 0.0, 0.0])
    plain, told = [], []
    for _ in range(150):
        points = watched(rng, ball_turns(rng, 30), frame=aside).points
        plain.append(fit_running(points).center)
        told.append(fit_running(points, shape=relative(points, aside, np.zeros(3))).center)
    assert np.linalg.norm(np.mean(told, axis=0)) < 0.85 * np.linalg.norm(np.mean(plain, axis=0))
