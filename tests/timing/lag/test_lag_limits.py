"""Limits of the lag: overlap, standard deviation, step between samples, and the reported text."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest

from jointfit_daemon.timing.lag import LagEstimate, LagTracker, rates_from_orientations
from jointfit_daemon.timing.lag._angular_rates import Rates
from jointfit_daemon.timing.lag._estimate import _correlations
from jointfit_daemon.timing.lag._gate import _sd_text
from jointfit_daemon.timing.lag._standard_deviation import _jackknife

PERIOD_S = 0.01


def rates(begin_s: float, count: int) -> Rates:
    """Return `count` rates of one movement, from the instant `begin_s` on."""
    t = begin_s + PERIOD_S * np.arange(count, dtype=np.float64)
    w = np.column_stack([np.sin(3.0 * t) + 2.0, np.cos(7.0 * t), 0.3 * t])
    return Rates(t, w, np.zeros(count, dtype=np.intp), PERIOD_S, 1.0)


def test_lags_with_an_overlap_of_less_than_half_are_not_compared() -> None:
    reach = 150
    scores = _correlations(rates(0.0, 200), rates(0.0, 200), PERIOD_S, reach)
    compared = np.flatnonzero(np.isfinite(scores)) - reach
    assert np.abs(compared).max() == pytest.approx(100, abs=2)
    assert np.argmax(scores) == reach


def test_the_jackknife_variance_of_a_mean_is_its_usual_variance() -> None:
    values = np.array([1.0, 2.0, 4.0, 9.0])
    table = np.zeros((4, 56))
    table[:, :49] = np.eye(7).ravel()
    table[:, 55] = values
    found = _jackknife(table, 4.0 * np.eye(7))
    assert found == pytest.approx(values.var(ddof=1) / 4.0)


def test_a_standard_deviation_is_reported_in_milliseconds() -> None:
    assert _sd_text(2_340_000.0, 500_000.0) == "2.34 ms > 0.50 ms"
    assert "only one moment" in _sd_text(inf, 500_000.0)


def test_windows_overlap_to_three_quarters_so_their_variance_counts_four_times() -> None:
    """Every instant is in four windows, so the variance of one window is multiplied by four."""
    tracked = LagTracker().feed(0, LagEstimate(5e6, 1e5, 0.0, None))
    assert tracked is not None
    assert tracked.lag_ns == pytest.approx(5e6)
    assert tracked.sigma_ns == pytest.approx(2e5)


def test_a_step_shorter_than_half_a_period_has_a_rate() -> None:
    t_ms = np.array([0, 10, 20, 24, 34, 44])
    angle = 0.002 * t_ms
    q = np.column_stack([np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle])
    found = rates_from_orientations(t_ms * 1_000_000, q, 0)
    assert found.t_s == pytest.approx([0.005, 0.015, 0.022, 0.029, 0.039])
    assert found.w[:, 0] == pytest.approx(2.0)
