"""Heading drift filter: tracking, robustness to soft-tissue bias, and standard deviation."""

from __future__ import annotations

import numpy as np
import pytest

from jointfit_daemon.fusion.faults._heading_drift import OUTLIER_SIGMA, HeadingDriftFilter

S = 1_000_000_000


def follow(
    rate_deg_min: float, *, seed: int, spread_deg: float = 3.0, seconds: int = 400
) -> tuple[np.ndarray, np.ndarray]:
    """Return error and estimated standard deviation of the heading, deg, for every second.

    Half of the measurement variance is bias (soft tissue, correlation time 15 s), half is noise.
    """
    rng, drift = np.random.default_rng(seed), HeadingDriftFilter(np.radians(spread_deg))
    keep, share = np.exp(-1 / 15), spread_deg * np.sqrt(0.5)
    bias, rows = rng.normal() * share, []
    for second in range(seconds):
        bias = keep * bias + rng.normal() * share * np.sqrt(1 - keep**2)
        true = rate_deg_min * second / 60
        for _ in range(25):
            drift.add_measurement(np.radians(true + bias + rng.normal() * share))
        drift.step(second * S)
        rows.append((np.degrees(drift.heading) - true, np.degrees(drift.sd)))
    errors, sds = np.array(rows).T
    return errors, sds


@pytest.mark.parametrize("rate", [0.0, 1.0, 3.0, 10.0, -10.0])
def test_drift_is_tracked_within_the_soft_tissue_error(rate: float) -> None:
    left = [follow(rate, seed=seed)[0][120:] for seed in range(8)]
    assert np.sqrt(np.mean(np.square(left))) < (1.6 if abs(rate) < 10 else 2.2)


def test_standard_deviation_matches_the_error() -> None:
    runs = [follow(2.0, seed=seed) for seed in range(20)]
    ratio = np.sqrt(np.mean([np.mean((e[60:] / sd[60:]) ** 2) for e, sd in runs]))
    assert 0.6 < ratio < 1.25


def test_standard_deviation_grows_without_measurements() -> None:
    drift = HeadingDriftFilter(np.radians(3.0))
    sds = []
    for second in range(600):
        drift.step(second * S)
        sds.append(np.degrees(drift.sd))
    assert sds == sorted(sds)
    assert sds[60] > 2.5
    assert sds[-1] > 15
    assert drift.heading == 0.0


def test_outliers_are_rejected() -> None:
    drift = HeadingDriftFilter(np.radians(2.0))
    for second in range(60):
        for _ in range(25):
            drift.add_measurement(0.0 if second < 50 else np.radians(40.0))
        drift.step(second * S)
    assert abs(np.degrees(drift.heading)) < 0.5
    assert drift.rejected >= 9
    assert OUTLIER_SIGMA < 40 / 2
