"""Gait cycles of simulated subjects: instants, mean curves and refusals against ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jointfit_daemon.session_analysis import GaitCycles, find_gait_cycles, normalize_cycles
from jointfit_daemon.session_data import SegmentSeries, SessionData
from jointfit_simulators.body import Step
from tests.session_analysis.simulated_session import STRIDE_S, simulated_session, true_angle

WALK = (Step("walk", 20.0),)
SUBJECTS = range(1, 11)


def shank_of(session: SessionData, name: str = "shank") -> SegmentSeries:
    return next(series for series in session.segments if series.name == name)


@pytest.fixture(scope="module")
def walks() -> dict[int, tuple[SessionData, GaitCycles]]:
    sessions = {seed: simulated_session(WALK, seed=seed, cameras=False) for seed in SUBJECTS}
    return {seed: (s, find_gait_cycles(shank_of(s))) for seed, s in sessions.items()}


@pytest.mark.experiment
def test_every_stride_of_every_subject_is_found_once(
    walks: dict[int, tuple[SessionData, GaitCycles]],
) -> None:
    assert [len(gait.cycles_s) for _, gait in walks.values()] == [17] * len(SUBJECTS)
    durations = np.array([gait.durations_s for _, gait in walks.values()])
    errors = np.abs(durations - STRIDE_S)
    assert np.median(errors) < 0.004
    assert errors.max() < 0.02


@pytest.mark.experiment
def test_initial_contact_is_near_the_heel_strike(
    walks: dict[int, tuple[SessionData, GaitCycles]],
) -> None:
    starts = np.array([gait.cycles_s[:, 0] for _, gait in walks.values()])
    delay_s = (starts + STRIDE_S / 2) % STRIDE_S - STRIDE_S / 2

    # A contact is detected where the rotation of the shank reverses, shortly before the heel
    # strikes.
    assert -0.04 < np.median(delay_s) < 0.0
    assert np.abs(delay_s - np.median(delay_s)).max() < 0.015


@pytest.mark.experiment
def test_mean_curve_of_the_knee_equals_the_true_one(
    walks: dict[int, tuple[SessionData, GaitCycles]],
) -> None:
    rms_deg, sd_error_deg = [], []
    for seed, (session, gait) in walks.items():
        knee = session.joints[0]
        found = normalize_cycles(knee.t_s, knee.angles["flexion"], gait.cycles_s)
        # The reference cycles have the true length. They begin at the heel strikes, shifted by the
        # mean offset of the detected contacts.
        strikes = np.round(gait.cycles_s[:, 0] / STRIDE_S) * STRIDE_S
        begin = strikes + (gait.cycles_s[:, 0] - strikes).mean()
        cycles = np.column_stack([begin, begin + STRIDE_S])
        angle = true_angle(WALK, seed, "leg", "knee", knee.t_s)
        true = normalize_cycles(knee.t_s, angle, cycles)
        rms_deg.append(np.degrees(np.sqrt(np.mean((found.mean - true.mean) ** 2))))
        sd_error_deg.append(np.degrees(np.abs(found.sd - true.sd).mean()))
    assert np.median(rms_deg) < 0.3
    assert max(rms_deg) < 0.6
    assert max(sd_error_deg) < 1.2  # errors of about 1.1 deg per segment add to the variation


@pytest.mark.parametrize(
    "motion",
    ["stand", "squat", "sit_to_stand", "hip_circles", "knee_swings", "leg_swings", "ankle_circles"],
)
def test_other_movements_are_refused_with_a_reason(motion: str) -> None:
    for seed in (1, 2, 3):
        session = simulated_session((Step(motion, 20.0),), seed=seed, cameras=False)
        gait = find_gait_cycles(shank_of(session))
        assert len(gait.cycles_s) == 0
        assert gait.refused


def test_both_legs_walk_half_a_stride_apart() -> None:
    session = simulated_session(WALK, limb="legs", cameras=False)
    right, left = (
        find_gait_cycles(shank_of(session, f"{side}_shank")).cycles_s for side in ("right", "left")
    )
    phase = (left[0, 0] - right[0, 0]) % STRIDE_S
    assert phase == pytest.approx(STRIDE_S / 2, abs=0.02)


def test_walking_within_other_movements_is_found() -> None:
    steps = (Step("squat", 12.0), Step("walk", 12.0), Step("stand", 8.0))
    gait = find_gait_cycles(shank_of(simulated_session(steps, cameras=False)))
    assert len(gait.cycles_s) >= 8
    assert gait.cycles_s.min() > 12.0
    assert gait.cycles_s.max() < 26.0


def test_no_cycle_extends_over_a_gap() -> None:
    shank = shank_of(simulated_session(WALK, cameras=False))
    kept = (shank.t_s < 8.0) | (shank.t_s > 9.0)
    assert shank.sd_rad is not None
    cut = replace(
        shank, t_s=shank.t_s[kept], orientation=shank.orientation[kept], sd_rad=shank.sd_rad[kept]
    )
    gait = find_gait_cycles(cut)
    assert 10 <= len(gait.cycles_s) < 17
    assert not ((gait.cycles_s[:, 0] < 9.0) & (gait.cycles_s[:, 1] > 8.0)).any()


@pytest.mark.parametrize(
    ("t_s", "w", "reason"),
    [
        (np.empty(0), 1.0, "the orientation of the shank is unknown"),
        (np.arange(0.0, 5.0, 0.01), np.nan, "the orientation of the shank is unknown"),
        (np.zeros(1), 1.0, "the orientation of the shank is nowhere known for 0.6 s without a gap"),
        (
            np.arange(0.0, 0.5, 0.01),
            1.0,
            "the orientation of the shank is nowhere known for 0.6 s without a gap",
        ),
        (
            np.arange(0.0, 60.0, 0.05),
            1.0,
            "the shank has 20.0 orientations per second, at least 24 are needed",
        ),
    ],
)
def test_series_without_angular_velocity_is_refused_with_the_cause(
    t_s: np.ndarray, w: float, reason: str
) -> None:
    q = w * np.tile([1.0, 0.0, 0.0, 0.0], (len(t_s), 1))
    gait = find_gait_cycles(SegmentSeries("shank", t_s, q))
    assert gait.cycles_s.shape == (0, 2)
    assert gait.refused == reason


def test_cycles_with_unknown_values_are_left_out() -> None:
    t_s = np.arange(0.0, 10.0, 0.01)
    values = np.sin(2 * np.pi * t_s)
    values[250:260] = np.nan
    cycles = np.column_stack([np.arange(1.0, 8.0), np.arange(2.0, 9.0)])
    curves = normalize_cycles(t_s, values, cycles)
    assert curves.cycles.shape == (6, 101)
    np.testing.assert_allclose(curves.mean, np.sin(2 * np.pi * curves.percent / 100), atol=1e-3)
    np.testing.assert_allclose(curves.sd, 0.0, atol=1e-6)
