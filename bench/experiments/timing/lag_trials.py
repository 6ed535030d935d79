"""Lag windows of all recorded trials and of short passages, and errors of the recorded stamps.

The stamps of the recordings have a sawtooth error with the height of one tick of the sensor's
clock, 0.5 ms. A window with one second of fast motion covers only a part of the sawtooth period, so
the residuals of the lag fit do not show the error.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.experiments.timing.lag import (
    FAST,
    HALF_FRAME_MS,
    Recording,
    whole,
    windows,
    worst_ratio,
)
from bench.framework.experiment import Experiment, Result
from bench.framework.material import BOARD
from bench.subjects.gyro_rates import rates_from_gyro
from jointfit_daemon.timing.lag import Rates, estimate_lag_of_rates, rates_from_orientations
from jointfit_daemon.units import NS_PER_MS

if TYPE_CHECKING:
    from pathlib import Path

LENGTHS_S = (1.0, 2.0, 5.0, 10.0)
HOP_S = {1.0: 0.5}
"""Time between the starts of windows, s, by window length, if it is not 2.5 s."""
TICK_MS, TICK_TOLERANCE_MS = 0.5, 0.05
"""Tick of the sensor's clock (1/2000 s), and tolerance of its measured value, ms."""
SAWTOOTH_HZ = np.arange(0.3, 1.0, 0.002)
"""Frequencies for the search of the sawtooth, Hz. The first 26 s of a trial are at rest."""


def all_trials(data: Path) -> list[Result]:
    """Measure the largest ratio of error to standard deviation, by trial and window length."""
    figures = []
    for path in sorted((data / "broad").glob("*.hdf5")):
        recording = whole(data, path.stem)
        for length_s in LENGTHS_S:
            found = windows(recording, length_s, hop_s=HOP_S.get(length_s, 2.5))
            off = [abs(one.lag_ms - HALF_FRAME_MS) / one.sigma_ms for one in found if one.used]
            figures.append(worst_ratio(f"trial {path.stem[:2]}: {length_s:g} s", off))
    period_s, height_ms = stamp_sawtooth(whole(data, FAST))
    return [
        *figures,
        Result("sawtooth of the stamps: period", period_s, unit="s"),
        Result(
            "sawtooth of the stamps: height",
            height_ms,
            TICK_MS + TICK_TOLERANCE_MS,
            TICK_MS - TICK_TOLERANCE_MS,
            "ms",
        ),
    ]


def stamp_sawtooth(recording: Recording) -> tuple[float, float]:
    r"""Return the period, s, and the height, ms, of the sawtooth error of the sensor's stamps.

    A stamp error e(t) adds :math:`\dot g(t) e(t)` to the residual of the lag fit, where g is the
    angular rate. The first harmonic of e is fitted by least squares. For a sawtooth of height A,
    its amplitude is :math:`A / \pi`.
    """
    imu = rates_from_gyro(recording.t_ns, recording.gyro, 0)
    ref = rates_from_orientations(recording.t_ns, recording.optical, 0)
    lag_s = 1e-9 * estimate_lag_of_rates(imu, ref).lag_ns
    at = ref.t_s + lag_s
    inside = (at > imu.t_s[0]) & (at < imu.t_s[-1])
    t_s, omega = ref.t_s[inside], ref.w[inside]
    g = np.stack([np.interp(at[inside], imu.t_s, imu.w[:, k]) for k in range(3)], axis=1)

    # The residual along the angular acceleration is the local stamp error times the squared
    # acceleration.
    residual = g - omega - np.mean(g - omega, axis=0)
    slope = np.gradient(_smooth(omega, ref), ref.period_s, axis=0)
    pull, weight = np.sum(slope * residual, axis=1), np.sum(slope**2, axis=1)

    best = (0.0, 0.0, 0.0)
    for hz in SAWTOOTH_HZ:
        angle = 2.0 * np.pi * hz * t_s
        basis = np.stack([np.ones_like(t_s), np.cos(angle), np.sin(angle)], axis=1)
        right = basis.T @ pull
        fit = np.linalg.solve(basis.T @ (basis * weight[:, None]), right)
        best = max(best, (float(fit @ right), 1.0 / hz, float(np.hypot(fit[1], fit[2]))))
    return best[1], 1e9 * np.pi * best[2] / NS_PER_MS


def _smooth(omega: np.ndarray, rates: Rates) -> np.ndarray:
    """Return the rates without noise above 20 Hz, so their slope is the slope of the motion."""
    width = round(0.025 / rates.period_s) | 1
    kernel = np.hanning(width + 2)
    kernel /= kernel.sum()
    return np.stack([np.convolve(omega[:, k], kernel, "same") for k in range(3)], axis=1)


EXPERIMENTS = (
    Experiment(
        "lag-all-trials",
        "Largest ratio of the lag error to its standard deviation, all trials and short passages",
        all_trials,
        BOARD,
        ("broad",),
        ("h5py",),
        long=True,
    ),
)
