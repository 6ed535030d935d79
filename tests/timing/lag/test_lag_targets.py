"""Lag estimates from rest, short passages and continuous motion.

The module tests/bench/test_tables.py tests the thresholds of the lag experiments.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.experiments.timing import lag
from bench.subjects.gyro_rates import rates_from_gyro
from jointfit_daemon.timing.lag import LagSettings, estimate_lag_of_rates, rates_from_orientations
from jointfit_daemon.units import NS_PER_MS

if TYPE_CHECKING:
    from pathlib import Path

TICK_MS, PERIOD_S = 0.5, 3.9
"""Sawtooth error of stamps in ticks of 0.5 ms: height (ms) and period (s). A clock skew of 128
ppm shifts the stamps by one tick in 3.9 s."""


def test_a_tap_in_a_window_of_rest_is_no_lag() -> None:
    """A movement of 0.25 s in a window of rest does not determine a lag."""
    t_imu, q_imu, t_ref, q_ref = lag.made_up(1, 10.0, 5.0)
    for t, q in ((t_imu, q_imu), (t_ref, q_ref)):
        q[t < 5.0e9] = q[t < 5.0e9][-1]
        q[t > 5.25e9] = q[t > 5.25e9][0]
    found = lag.estimate_between(lag.LagTracks(t_imu, q_imu, t_ref, q_ref), 0.4, 9.6)
    assert found.refused is not None


def errors_of_short_passages(data: Path, settings: LagSettings) -> list[float]:
    """Return |lag error| / standard deviation for passages of 1 s, without refused passages."""
    recording = lag.excerpt(data, lag.FAST)
    body = rates_from_orientations(recording.t_ns, recording.optical, 0)
    rng = np.random.default_rng(1)
    gyro = body.w + rng.normal(scale=np.radians(1.0), size=body.w.shape)
    sawtooth_ms = TICK_MS * (body.t_s / PERIOD_S % 1.0 - 0.5)
    t_ns = np.rint(1e9 * body.t_s + NS_PER_MS * sawtooth_ms).astype(np.int64)
    found = []
    for start_s in np.linspace(4.0, 58.0, 32):
        near = np.abs(body.t_s - start_s - 0.5) < 0.8
        seen = np.abs(1e-9 * recording.t_ns - start_s - 0.5) < 0.5
        imu = rates_from_gyro(t_ns[near], gyro[near], 0)
        ref = rates_from_orientations(recording.t_ns[seen], recording.optical[seen], 0)
        estimate = estimate_lag_of_rates(imu, ref, settings)
        if estimate.refused is None:
            found.append(abs(estimate.lag_ns) / estimate.sigma_ns)
    return found


def test_the_standard_deviation_contains_the_stamp_error_of_a_short_passage(
    shared_data: Path,
) -> None:
    found = errors_of_short_passages(shared_data, LagSettings())
    assert len(found) >= 20
    assert max(found) < 4.0
    # Without `stamp_sd_ns`, the standard deviation comes from the residuals alone, which do not
    # show the stamp error.
    assert max(errors_of_short_passages(shared_data, LagSettings(stamp_sd_ns=0.0))) > 4.0


def test_even_motion_averages_the_stamp_error(shared_data: Path) -> None:
    """In ten seconds of continuous motion, the sawtooth error of the stamps averages out."""
    recording = lag.excerpt(shared_data, lag.FAST)
    part = (recording.t_ns > 10e9) & (recording.t_ns < 20e9)
    imu = rates_from_gyro(recording.t_ns[part], recording.gyro[part], 0)
    ref = rates_from_orientations(recording.t_ns[part], recording.optical[part], 0)
    assert estimate_lag_of_rates(imu, ref).sigma_ns < 0.06 * NS_PER_MS
