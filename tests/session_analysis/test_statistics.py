"""Range of motion, difference from the cameras and gaps equal values known by construction."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.session_analysis import angle_difference, motion_range, series_quality
from jointfit_daemon.session_data import JointSeries

T_S = np.arange(0.0, 20.0, 0.01)


def joint(values: np.ndarray, t_s: np.ndarray = T_S, sd: float | None = None) -> JointSeries:
    sds = {} if sd is None else {"flexion": np.full(len(t_s), sd)}
    return JointSeries("knee", t_s, {"flexion": values}, sds)


def test_range_of_motion_ignores_unknown_values() -> None:
    values = np.linspace(-0.2, 1.2, len(T_S))
    values[100:200] = np.nan
    found = motion_range(joint(values, sd=0.03), "flexion")
    assert found is not None
    assert (found.minimum, found.maximum) == pytest.approx((-0.2, 1.2))
    assert found.extent == pytest.approx(1.4)
    assert found.extent_sd == pytest.approx(0.03 * np.sqrt(2.0))
    assert found.known_share == pytest.approx(0.95)
    assert found.minimum < found.low < found.median < found.high < found.maximum


def test_unknown_angle_has_no_range() -> None:
    assert motion_range(joint(np.full(len(T_S), np.nan)), "flexion") is None


@given(bias=st.floats(-0.5, 0.5), sd=st.floats(0.01, 0.1), seed=st.integers(0, 99))
def test_difference_has_the_bias_and_deviation_it_was_made_with(
    bias: float, sd: float, seed: int
) -> None:
    true = 0.5 * np.sin(T_S)
    noise = np.random.default_rng(seed).normal(bias, sd, len(T_S))
    found = angle_difference(joint(true + noise, sd=np.hypot(bias, sd)), joint(true), "flexion")
    assert found is not None
    assert found.bias == pytest.approx(bias, abs=5 * sd / np.sqrt(len(T_S)))
    assert found.sd == pytest.approx(sd, rel=0.1)
    assert found.rms == pytest.approx(np.hypot(found.bias, found.sd))
    assert found.coverage > 0.85
    assert found.limits[0] < found.bias < found.limits[1]


def test_difference_of_angles_at_half_a_turn_is_small() -> None:
    near = np.full(len(T_S), np.pi - 0.01)
    found = angle_difference(joint(near), joint(-near), "flexion")
    assert found is not None
    assert found.rms == pytest.approx(0.02)


def test_instants_without_one_of_both_are_left_out() -> None:
    values = np.sin(T_S)
    hidden = np.where(T_S < 5.0, np.nan, values)
    found = angle_difference(joint(values), joint(hidden), "flexion")
    assert found is not None
    assert found.t_s[0] >= 5.0
    later = joint(values, T_S + 100.0)
    assert angle_difference(joint(values), later, "flexion") is None


def test_gaps_and_losses_are_found() -> None:
    kept = np.ones(len(T_S), bool)
    kept[500:700] = False
    kept[1000] = False  # a single sample is a loss, and no gap
    found = series_quality(T_S[kept])
    assert found.rate_hz == pytest.approx(100.0)
    assert found.lost_share == pytest.approx(201 / len(T_S), abs=1e-3)
    np.testing.assert_allclose(found.gaps_s, [[4.99, 7.0]])


def test_short_series_has_no_loss_and_no_gap() -> None:
    assert np.isnan(series_quality(T_S[:1]).lost_share)
    assert len(series_quality(T_S[:0]).gaps_s) == 0
