"""Robust scale, Huber weights, and the effective number of samples of a correlated series."""

from __future__ import annotations

import numpy as np
import pytest

from jointfit_daemon.calibration._robust_weights import effective_count, huber_weights, robust_scale


def test_the_robust_scale_is_the_deviation_in_spite_of_a_third_of_outliers() -> None:
    rng = np.random.default_rng(0)
    r = np.abs(rng.normal(0, 2.0, 20_000))
    assert robust_scale(r) == pytest.approx(2.0, rel=0.03)
    r[: len(r) // 10] = 1e9
    assert robust_scale(r) == pytest.approx(2.0, rel=0.2)
    assert robust_scale(np.zeros(5), floor=1e-3) == 1e-3


def test_only_outliers_have_reduced_weight() -> None:
    weights = huber_weights(np.array([0.0, 1.4, 1.5, 3.0, 1e6]), 1.0)
    assert np.allclose(weights, [1.0, 1.0, 1.0, 0.5, 1.5e-6])


def test_correlated_series_has_fewer_effective_samples() -> None:
    rng = np.random.default_rng(1)
    white = rng.normal(size=(4000, 3))
    slow = np.empty_like(white)
    slow[0] = white[0]
    for i in range(1, len(white)):
        slow[i] = 0.9 * slow[i - 1] + white[i]
    assert effective_count(white) == pytest.approx(4000, rel=0.06)
    assert effective_count(slow) == pytest.approx(4000 * 0.1 / 1.9, rel=0.2)
    assert effective_count(np.ones((50, 3))) == 50.0
