"""Poses from markers by the sequential solver, which solves one instant at a time."""

from __future__ import annotations

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
    MOST_EVALUATIONS,
    IkOptions,
    LiveInverseKinematics,
    LiveOptions,
    LivePose,
    solve_frames,
    tracking_error,
)

COUNT = 120
NOISE = 0.002


def limb() -> ChainModel:
    rng = np.random.default_rng(4)
    knee = Joint("ball", (0.0, 0.0, -0.4))
    return ChainModel(
        (Segment("thigh"), Segment("shank", "thigh", knee)),
        tuple(
            Marker(f"{s}{k}", s, tuple(rng.normal((0.0, 0.0, -0.2), 0.07).tolist()))
            for s in ("thigh", "shank")
            for k in range(4)
        ),
    )


def swing(model: ChainModel, count: int = COUNT) -> ChainState:
    phase = np.linspace(0.0, 2.0 * np.pi, count)
    step = np.zeros((count, model.nq))
    step[:, 0] = 0.4 * np.sin(phase)
    step[:, 2] = 2.0
    step[:, 3:6] = 0.4 * np.stack((phase, np.cos(phase), 0.1 * phase), axis=-1)
    step[:, 6] = 0.6 - 0.6 * np.cos(phase)
    return apply_step(model, rest_state(model, count), step)


def followed(
    model: ChainModel, y: np.ndarray, options: LiveOptions | None = None
) -> list[LivePose]:
    live = LiveInverseKinematics(model, options)
    return [live.feed(row) for row in y]


def joined(poses: list[LivePose]) -> ChainState:
    return ChainState(
        np.concatenate([p.state.rotations for p in poses]),
        np.concatenate([p.state.origins for p in poses]),
    )


def noisy(model: ChainModel, state: ChainState, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.asarray(marker_positions(model, state) + rng.normal(0, NOISE, (len(state), 8, 3)))


def test_two_steps_an_instant_fit_as_well_as_a_full_search() -> None:
    model = limb()
    y = noisy(model, swing(model))
    live = np.array([p.residuals for p in followed(model, y)])
    full = solve_frames(model, y)
    assert tracking_error(live) == pytest.approx(tracking_error(full.residuals), rel=1e-3)


def test_the_covariance_is_that_of_the_errors() -> None:
    model = limb()
    truth = swing(model, 400)
    poses = followed(model, noisy(model, truth))[100:]
    off = step_between(model, truth.take(slice(100, None)), joined(poses))
    normalized = [o @ np.linalg.solve(p.covariance, o) for o, p in zip(off, poses, strict=True)]
    assert np.mean(normalized) / model.nq == pytest.approx(1.0, abs=0.15)


def test_a_configured_marker_error_scales_the_covariance() -> None:
    model = limb()
    y = noisy(model, swing(model))[:5]
    fine = followed(model, y, LiveOptions(marker_sd_m=0.001))[-1].covariance
    coarse = followed(model, y, LiveOptions(marker_sd_m=0.004))[-1].covariance
    np.testing.assert_allclose(coarse, 16 * fine, rtol=1e-6)


def test_undetermined_joints_are_held_reported_and_uncertain() -> None:
    model = limb()
    truth = swing(model)
    y = marker_positions(model, truth)
    y[50:55, 5:] = np.nan  # only one marker of the shank is visible
    poses = followed(model, y)
    assert [i for i, p in enumerate(poses) if p.underdetermined] == list(range(50, 55))
    off = step_between(model, truth, joined(poses))
    assert np.degrees(np.abs(off[50:55, 6:])).max() < 10
    assert np.degrees(np.abs(off[56:, 6:])).max() < 0.01
    assert np.diag(poses[52].covariance)[6:].max() > 20 * np.diag(poses[49].covariance)[6:].max()


def test_with_no_marker_at_all_the_last_pose_stays() -> None:
    model = limb()
    y = marker_positions(model, swing(model))
    y[10:12] = np.nan
    poses = followed(model, y[:14])
    assert poses[11].underdetermined
    np.testing.assert_allclose(poses[11].rotations, poses[9].rotations, atol=1e-12)
    assert np.isnan(poses[11].residuals).all()
    assert not poses[13].underdetermined


def test_a_subject_returning_rotated_is_found_again() -> None:
    model = limb()
    y = marker_positions(model, swing(model, 10))
    away = y[5:] @ np.diag([-1.0, -1.0, 1.0]) + (2.0, 1.0, 0.0)
    poses = followed(model, np.concatenate((y[:5], away)))
    assert [p.restarted for p in poses] == [True, *[False] * 4, True, *[False] * 4]
    assert max(np.abs(p.residuals).max() for p in poses[5:]) < 3e-3


def test_huber_weights_reduce_the_effect_of_a_stray_marker() -> None:
    model = limb()
    truth = swing(model)
    y = noisy(model, truth)
    y[:, 2, 0] += 0.05

    def rms(options: LiveOptions) -> float:
        off = step_between(model, truth, joined(followed(model, y, options)))
        return float(np.sqrt(np.mean(off[5:, [0, 1, 2, 6, 7, 8]] ** 2)))

    assert rms(LiveOptions(huber_m=0.005)) < 0.5 * rms(LiveOptions())


def test_rotations_remain_orthonormal() -> None:
    model = limb()
    live = LiveInverseKinematics(model)
    y = noisy(model, swing(model, 30))
    pose = live.feed(y[0])
    for _ in range(60):
        for row in y:
            pose = live.feed(row)
    R = pose.state.rotations[0]
    np.testing.assert_allclose(
        R @ R.swapaxes(-1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-13
    )


def test_another_number_of_markers_is_refused() -> None:
    with pytest.raises(ValueError, match="expected \\(8, 3\\)"):
        LiveInverseKinematics(limb()).feed(np.zeros((7, 3)))


def hostile(y: np.ndarray) -> dict[str, np.ndarray]:
    """Return several versions of the markers `y` with faults, by name of the fault."""
    rng = np.random.default_rng(7)
    hidden, part, stray = y.copy(), y.copy(), y.copy()
    hidden[20:30] = np.nan
    part[20:, 3:] = np.nan
    stray[20:, 2] += 0.5
    return {
        "rotated": np.concatenate((y[:20], y[20:] @ np.diag([-1.0, -1.0, 1.0]) + (2.0, 1.0, 0.0))),
        "exchanged": np.concatenate((y[:20], y[20:, ::-1])),
        "too large": 1.5 * y,
        "random": rng.normal(0.0, 1.0, y.shape),
        "hidden": hidden,
        "few": part,
        "stray": stray,
    }


@pytest.mark.parametrize("fault", hostile(np.zeros((40, 8, 3))))
@pytest.mark.parametrize("huber_m", [None, 0.02])
def test_the_number_of_evaluations_is_limited_for_any_markers(
    fault: str, huber_m: float | None
) -> None:
    model = limb()
    y = hostile(noisy(model, swing(model, 40)))[fault]
    options = LiveOptions(steps=6, huber_m=huber_m, restart_interval=1)
    counts = [pose.evaluations for pose in followed(model, y, options)]
    assert max(counts) <= MOST_EVALUATIONS <= 16
    assert all(np.isfinite(pose.rotations).all() for pose in followed(model, y, options))


def test_a_healthy_instant_takes_three_evaluations() -> None:
    model = limb()
    y = noisy(model, swing(model, 400))
    counts = [pose.evaluations for pose in followed(model, y, LiveOptions(steps=6, huber_m=0.02))]
    assert np.mean(counts[1:]) < 3.2


@pytest.mark.parametrize("instant", range(0, COUNT, 15))
def test_a_restart_reaches_the_minimum_of_a_full_search(instant: int) -> None:
    model = limb()
    y = noisy(model, swing(model))[instant]
    first = LiveInverseKinematics(model, LiveOptions(huber_m=0.02)).feed(y)
    full = solve_frames(model, y[None], options=IkOptions(huber_m=0.02))
    assert first.restarted
    assert np.abs(step_between(model, full.state, first.state)).max() < 2e-4
