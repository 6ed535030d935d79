"""The demo interpolates the ground truth, computes RMS errors, and names missed targets."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.tools.demo._command import FLEXION_RMSE_DEG, missed_targets, result_line
from jointfit_daemon.tools.demo._score import (
    DemoScore,
    RmsAccumulator,
    TrueLimbState,
    TruthTrack,
    percentile,
)

IDENTITY = (1.0, 0.0, 0.0, 0.0)


def truth(t_ns: int, flexion: float) -> TrueLimbState:
    half = flexion / 2
    shank = (math.cos(half), -math.sin(half), 0.0, 0.0)
    centers = {"knee": (0.0, 0.0, t_ns / 1e9)}
    return TrueLimbState(t_ns, "walk", {"thigh": IDENTITY, "shank": shank}, centers, flexion)


def pose(flexion_deg: float | None, sd_deg: float = 1.0) -> dict[str, Any]:
    return {
        "segments": {"thigh": {"q": list(IDENTITY)}},
        "joints": {"knee": {"flexion_deg": flexion_deg, "sd_deg": sd_deg}},
    }


def test_truth_is_interpolated_between_rows_and_unknown_outside() -> None:
    track = TruthTrack()
    track.add(truth(0, 0.0))
    track.add(truth(10, 1.0))
    middle = track.at(5)
    assert middle is not None
    assert middle.flexion == pytest.approx(0.5)
    assert middle.orientations["shank"][0] == pytest.approx(math.cos(0.25))
    assert track.at(-1) is None
    assert track.at(11) is None


@given(st.lists(st.floats(-50, 50), min_size=1))
def test_the_score_is_the_root_mean_square_of_the_flexion_errors(errors: list[float]) -> None:
    score = DemoScore()
    for error in errors:
        score.add(pose(math.degrees(0.7) + error), truth(0, 0.7), "knee")
    expected = math.sqrt(sum(error**2 for error in errors) / len(errors))
    assert score.flexion.rms == pytest.approx(expected, abs=1e-6)


def test_an_unknown_knee_is_counted_and_not_scored_as_zero() -> None:
    score = DemoScore()
    score.add(pose(None), truth(0, 0.7), "knee")
    assert (score.flexion.n, score.frames) == (0, 1)


def figures(**changed: object) -> dict[str, Any]:
    good = {"knee_flexion_rmse_deg": 1.0, "unaccounted": 0, "latency_ms": {"p50": 1, "p99": 10}}
    return good | changed


def test_results_within_all_targets_miss_none() -> None:
    assert missed_targets(figures()) == []


@pytest.mark.parametrize(
    "worse",
    [
        {"knee_flexion_rmse_deg": FLEXION_RMSE_DEG["knee"] + 0.01},
        {"knee_flexion_rmse_deg": None},
        {"knee_flexion_rmse_deg": math.nan},
        {"unaccounted": 1},
        {"latency_ms": {"p50": 1, "p99": 61.0}},
        {"latency_ms": {"p50": None, "p99": None}},
    ],
)
def test_a_missed_or_unknown_target_is_named(worse: dict[str, object]) -> None:
    assert len(missed_targets(figures(**worse))) == 1


def test_samples_without_an_outcome_are_named_by_source_with_the_usual_cause() -> None:
    (missed,) = missed_targets(figures(unaccounted=5, unaccounted_by_source={"S1": 3, "S4": 2}))
    assert missed.startswith("unaccounted is 5, expected at most 0 (S1 3, S4 2): other programs")


@pytest.mark.parametrize("joint", ["elbow", "lumbar", "right_knee"])
def test_another_limb_is_evaluated_by_its_own_joint(joint: str) -> None:
    good = figures()
    del good["knee_flexion_rmse_deg"]
    key = f"{joint}_flexion_rmse_deg"
    assert missed_targets(good | {key: 1.0}) == []
    (missed,) = missed_targets(good | {key: FLEXION_RMSE_DEG[joint] + 0.01})
    assert missed.startswith(key)
    assert f"{joint} flexion error 1.0°" in result_line("passed", good | {key: 1.0})


def test_percentiles_of_an_empty_list_are_unknown() -> None:
    assert percentile([], 0.5) is None
    assert RmsAccumulator().rms is None
    assert percentile([3.0, 1.0, 2.0], 0.99) == 3.0
