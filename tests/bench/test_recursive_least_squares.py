"""Recursive fits equal batch fits without forgetting, follow changes, and remain stable at rest."""

from __future__ import annotations

import numpy as np
import pytest

from bench.baselines.recursive_least_squares import (
    IDLE_SAMPLES,
    InformationForm,
    RecursiveLeastSquares,
)


def test_without_forgetting_recursive_is_ridge_regression() -> None:
    rng = np.random.default_rng(0)
    g, y = rng.normal(size=(300, 6)), rng.normal(size=(300, 2))
    stepwise, sums = RecursiveLeastSquares(6, 2, 0.5), InformationForm(6, 2, 0.5)
    for row, target in zip(g, y, strict=True):
        assert stepwise.feed(row, target)
        sums.feed(row, target)
    augmented = np.vstack([g, np.sqrt(0.5) * np.eye(6)])
    batch = np.linalg.lstsq(augmented, np.vstack([y, np.zeros((6, 2))]), rcond=None)[0]
    assert np.allclose(stepwise.coefficients, batch, atol=1e-11)
    assert np.allclose(sums.coefficients, batch, atol=1e-11)


def test_a_fit_follows_a_change_only_with_forgetting() -> None:
    rng = np.random.default_rng(1)
    quick, slow = RecursiveLeastSquares(2, 1, 1e-3, 0.98), RecursiveLeastSquares(2, 1, 1e-3)
    for i in range(1000):
        g = rng.normal(size=2)
        y = [float(g @ ([1.0, 2.0] if i < 500 else [3.0, -1.0]))]
        quick.feed(g, y)
        slow.feed(g, y)
    assert np.allclose(quick.coefficients[:, 0], [3.0, -1.0], atol=1e-3)
    assert np.linalg.norm(slow.coefficients[:, 0] - [3.0, -1.0]) > 0.5


@pytest.mark.experiment
def test_an_hour_of_rest_does_not_make_the_fit_unstable() -> None:
    rng = np.random.default_rng(2)
    tracker = RecursiveLeastSquares(2, 1, 1e-3, 0.999)
    for _ in range(500):
        g = rng.normal(size=2)
        tracker.feed(g, [float(g @ [1.0, 2.0])])
    learned = tracker.coefficients.copy()
    taken = sum(tracker.feed([1e-4, 0.0], [1e-4 * rng.normal()]) for _ in range(100 * 3600))
    assert taken <= 100 * 3600 / IDLE_SAMPLES + 1
    tracker.feed([1.0, 1.0], [3.05])  # one noisy sample after the rest
    assert np.linalg.norm(tracker.coefficients - learned) < 0.5
    assert np.isfinite(tracker.coefficients).all()


def test_a_sample_with_a_smaller_weight_changes_the_fit_less() -> None:
    light, heavy = RecursiveLeastSquares(1, 1, 1.0), RecursiveLeastSquares(1, 1, 1.0)
    light.feed([1.0], [1.0], 0.1)
    heavy.feed([1.0], [1.0], 1.0)
    assert light.coefficients[0, 0] == pytest.approx(0.1 / 1.1)
    assert heavy.coefficients[0, 0] == pytest.approx(0.5)
    with pytest.raises(ValueError, match="forgetting 0"):
        RecursiveLeastSquares(1, 1, 1.0, 0.0)
