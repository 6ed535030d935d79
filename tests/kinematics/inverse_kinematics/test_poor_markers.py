"""Trials with too few markers: undetermined degrees of freedom are reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jointfit_daemon.kinematics.chains import (
    ChainModel,
    ChainState,
    Joint,
    Marker,
    Segment,
    apply_step,
    marker_positions,
    rest_state,
    step_between,
)
from jointfit_daemon.kinematics.inverse_kinematics import (
    LiveInverseKinematics,
    solve_frames,
    tracking_error,
)

COUNT = 30
SHANK = [4, 5, 6, 7]


def leg() -> ChainModel:
    rng = np.random.default_rng(9)
    knee = Joint("ball", (0.0, 0.0, -0.4))
    return ChainModel(
        (Segment("thigh"), Segment("shank", "thigh", knee)),
        tuple(
            Marker(f"{s}{k}", s, tuple(rng.normal((0.0, 0.0, -0.2), 0.08).tolist()))
            for s in ("thigh", "shank")
            for k in range(4)
        ),
    )


def bending(model: ChainModel) -> ChainState:
    step = np.zeros((COUNT, model.nq))
    step[:, 0] = np.linspace(0.0, 0.5, COUNT)
    step[:, 6] = np.linspace(0.0, -0.9, COUNT)
    return apply_step(model, rest_state(model, COUNT), step)


def thigh_off_deg(model: ChainModel, a: ChainState, b: ChainState) -> float:
    return float(np.degrees(np.abs(step_between(model, a, b)[:, :3]).max()))


def test_one_marker_on_a_segment_leaves_its_rotation_undetermined_and_its_parent_correct() -> None:
    model = leg()
    truth = bending(model)
    y = marker_positions(model, truth)
    y[:, SHANK[1:]] = np.nan
    found = solve_frames(model, y)
    assert found.underdetermined.all()
    assert np.isfinite(found.rotations).all()
    assert thigh_off_deg(model, truth, found.state) < 0.5
    assert tracking_error(found.residuals) < 0.001


def test_a_model_with_one_marker_on_a_segment_is_followed_live_with_a_wide_covariance() -> None:
    whole = leg()
    y = marker_positions(whole, bending(whole))
    model = replace(whole, markers=whole.markers[:5])
    live = LiveInverseKinematics(model)
    pose = [live.feed(row) for row in y[:, :5]][-1]
    assert pose.underdetermined
    sd = np.sqrt(np.diag(pose.covariance))
    assert np.isfinite(sd).all()
    assert sd[6:].max() > 10 * sd[:3].max()


@pytest.mark.parametrize("missing", [SHANK, [0, 1, 2, 3]])
def test_a_segment_without_markers_is_reported_and_stays(missing: list[int]) -> None:
    model = leg()
    truth = bending(model)
    y = marker_positions(model, truth)
    y[:, missing] = np.nan
    found = solve_frames(model, y)
    assert found.underdetermined.all()
    assert np.isnan(found.residuals[:, missing]).all()
    assert np.isfinite(found.origins).all()
    assert tracking_error(found.residuals) < 1e-3
    if missing == SHANK:  # a segment without markers does not move
        knee = np.diff(found.state.rotations[:, 1], axis=0)
        assert np.abs(knee).max() < 1e-6


def test_a_trial_in_millimetres_cannot_be_followed_by_a_model_in_metres() -> None:
    model = leg()
    found = solve_frames(model, 1000 * marker_positions(model, bending(model)))
    assert tracking_error(found.residuals) > 10.0
    assert np.isfinite(found.rotations).all()
