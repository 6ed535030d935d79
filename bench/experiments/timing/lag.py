"""Lag of an IMU behind the cameras, estimated from motion.

The optical data of the recordings are resampled at 120 Hz with a random phase. A random lag within
±50 ms is added to the stamps of the angular rate and subtracted from the estimates. Both recordings
have a true lag of half a camera frame, 1/240 s.
"""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bench.framework.experiment import Experiment, Result, median_and_worst
from bench.framework.material import BOARD, SEEDED
from bench.subjects.gyro_rates import rates_from_gyro
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.timing.lag import (
    LagEstimate,
    LagSettings,
    LagTracker,
    estimate_lag_of_rates,
    rates_from_orientations,
)
from jointfit_daemon.units import NS_PER_MS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

HALF_FRAME_MS = 1e3 / 240
FAST, SLOW = "07_undisturbed_fast_rotation_B", "02_undisturbed_slow_rotation_B"
MARGIN_S = 0.3
MOST_SIGMAS = 4.0
"""Largest allowed lag error of an accepted window, divided by its predicted standard deviation."""
FAST_SD_MS = {2.0: 0.054, 5.0: 0.025, 10.0: 0.02, 30.0: 0.02}
SLOW_SD_MS = {2.0: 0.307, 5.0: 0.21, 10.0: 0.14, 30.0: 0.14}
"""Target standard deviations of the lag, ms, by length of the window, s."""


class Recording(NamedTuple):
    t_ns: NDArray[np.int64]
    gyro: Floats
    optical: Floats


class Treatment(NamedTuple):
    """Disturbances of the optical data."""

    noise_deg: float = 0.0
    lost: float = 0.0
    hz: float = 120.0


class LagTracks(NamedTuple):
    """Stamps, ns, and orientations of a sensor and of the cameras."""

    t_imu: NDArray[np.int64]
    q_imu: Floats
    t_ref: NDArray[np.int64]
    q_ref: Floats


AS_IT_IS = Treatment()


class Window(NamedTuple):
    """Lag estimate of one window, minus the lag that was added to the stamps."""

    lag_ms: float
    sigma_ms: float
    used: bool


def excerpt(data: Path, name: str) -> Recording:
    with np.load(data / "broad_excerpts" / f"{name}_60s.npz") as file:
        gyro, optical = file["imu_gyr"].astype(float), file["opt_quat"].astype(float)
    return Recording(np.rint(np.arange(len(gyro)) * 3.5e6).astype(np.int64), gyro, optical)


def whole(data: Path, name: str) -> Recording:
    import h5py  # type: ignore[import-untyped]  # noqa: PLC0415 - only where recordings are

    with h5py.File(data / "broad" / f"{name}.hdf5") as file:
        gyro, optical = file["imu_gyr"][:], file["opt_quat"][:]
    return Recording(np.rint(np.arange(len(gyro)) * 3.5e6).astype(np.int64), gyro, optical)


def between(recording: Recording, stamps: Floats) -> Floats:
    """Return the optical orientations at given stamps, ns, interpolated along the shorter arc."""
    at = np.clip(np.searchsorted(recording.t_ns, stamps, "right") - 1, 0, len(recording.t_ns) - 2)
    a, b = recording.optical[at], recording.optical[at + 1]
    share = (stamps - recording.t_ns[at]) / (recording.t_ns[at + 1] - recording.t_ns[at])
    turn = rotation.log(rotation.multiply(rotation.conjugate(a), b))
    return rotation.multiply(a, rotation.exp(turn * share[:, None]))


def windows(
    recording: Recording,
    length_s: float,
    *,
    hop_s: float = 2.5,
    treatment: Treatment = AS_IT_IS,
    quaternions: Floats | None = None,
    seed: int = 6,
) -> list[Window]:
    """Estimate the lag in successive windows, each with another random lag in its stamps."""
    rng = np.random.default_rng(seed)
    noise_deg, lost, hz = treatment
    found = []
    last_s = recording.t_ns[-1] * 1e-9 - length_s - 0.02
    for start_s in np.arange(2.5, last_s, hop_s):
        stamps = 1e9 * np.arange(start_s + rng.uniform(0, 1 / hz), start_s + length_s, 1 / hz)
        optical = between(recording, stamps)
        noise = rng.normal(scale=np.radians(noise_deg), size=(len(stamps), 3))
        optical = rotation.multiply(optical, rotation.exp(noise))
        optical[rng.random(len(stamps)) < lost] = np.nan
        injected = round(rng.uniform(-50, 50) * NS_PER_MS)
        near = np.abs(recording.t_ns - np.mean(stamps)) < 5e8 * length_s + 1e9 * MARGIN_S
        t_ns = recording.t_ns[near] + injected
        if quaternions is None:
            imu = rates_from_gyro(t_ns, recording.gyro[near], 0)
        else:
            imu = rates_from_orientations(t_ns, quaternions[near], 0)
        ref = rates_from_orientations(np.rint(stamps).astype(np.int64), optical, 0)
        estimate = estimate_lag_of_rates(imu, ref)
        lag_ms = (estimate.lag_ns - injected) / NS_PER_MS
        found.append(Window(lag_ms, estimate.sigma_ns / NS_PER_MS, estimate.refused is None))
    return found


def excerpts(
    name: str, sd_goals_ms: Mapping[float, float], constant: tuple[float, float], data: Path
) -> list[Result]:
    recording = excerpt(data, name)
    imu = rates_from_gyro(recording.t_ns, recording.gyro, 0)
    estimate = estimate_lag_of_rates(
        imu, rates_from_orientations(recording.t_ns, recording.optical, 0)
    )
    middle, off = constant
    figures = [
        Result("whole minute", estimate.lag_ns / NS_PER_MS, middle + off, middle - off, "ms")
    ]
    for length_s in (2.0, 5.0, 10.0, 30.0):
        tries = [windows(recording, length_s, seed=seed) for seed in (6, 7, 8, 9)]
        used = [one for found in tries for one in found if one.used]
        lags = np.array([one.lag_ms for one in used])
        sigmas = np.array([one.sigma_ms for one in used])
        goal = sd_goals_ms[length_s]
        label = f"{length_s:g} s windows"
        figures += [
            Result(
                f"{label}, standard deviation",
                float(lags.std()),
                goal,
                unit="ms",
                note=f"{len(used)} windows",
            ),
            *median_and_worst(f"{label}, error", np.abs(lags - HALF_FRAME_MS).tolist(), "ms"),
            *median_and_worst(f"{label}, stated standard deviation", sigmas.tolist(), "ms"),
        ]
    return figures


def honest(data: Path) -> list[Result]:
    """Check that no error of an accepted window exceeds four predicted standard deviations.

    Each disturbance of the optical data is checked separately.
    """
    treatments = {
        "as recorded": AS_IT_IS,
        "0.3 deg optical noise": Treatment(noise_deg=0.3),
        "20 % of the frames lost": Treatment(lost=0.2),
        "60 Hz optics": Treatment(hz=60.0),
    }
    figures = []
    for name in (FAST, SLOW):
        recording = whole(data, name)
        for label, treatment in treatments.items():
            for length_s in (2.0, 5.0, 10.0):
                off = [
                    abs(one.lag_ms - HALF_FRAME_MS) / one.sigma_ms
                    for one in windows(recording, length_s, treatment=treatment)
                    if one.used
                ]
                what = f"{name[15:19]}, {label}: {length_s:g} s"
                figures.append(worst_ratio(what, off))
    return figures


def worst_ratio(name: str, ratios: Sequence[float]) -> Result:
    """Return the largest of the ratios of error to predicted sd; the note contains the median."""
    note = f"{len(ratios)} windows, median {np.median(ratios):.2f} sd" if ratios else "no windows"
    return Result(name, max(ratios, default=0.0), MOST_SIGMAS, unit="sd", note=note)


def quaternion_input(data: Path) -> list[Result]:
    """Measure by how much integrated orientations lead the angular rate: half a sample period.

    The lead must be the same if the orientations are rounded.
    """
    recording = excerpt(data, FAST)
    steps = rotation.exp(recording.gyro * 0.0035)
    path = np.empty_like(steps)
    path[0] = rotation.IDENTITY
    for k in range(1, len(steps)):
        path[k] = rotation.multiply(path[k - 1], steps[k])
    path = rotation.normalize(path)
    gyro = np.array([one.lag_ms for one in windows(recording, 10.0) if one.used])
    figures = []
    for label, grid in (("exact", None), ("rounded to 1/32768", 32768.0), ("rounded to 1e-4", 1e4)):
        coarse = path if grid is None else rotation.normalize(np.rint(path * grid) / grid)
        found = np.array([o.lag_ms for o in windows(recording, 10.0, quaternions=coarse) if o.used])
        lead = float(gyro.mean() - found.mean())
        figures.append(Result(f"lead of the orientation, {label}", lead, 1.85, 1.65, "ms"))
        figures.append(Result(f"standard deviation, {label}", float(found.std()), 0.02, unit="ms"))
    return figures


def made_up(
    seed: int, seconds: float, lag_ms: float, *, drift: float = 0.0, noise: float = 0.1
) -> LagTracks:
    """Return simulated stamps and orientations of a sensor and of the cameras.

    The stamps of the sensor are late by `lag_ms`, and its clock is fast by the fraction `drift`.
    The orientations of the cameras have noise with the standard deviation `noise` per axis, deg,
    and the orientations of the sensor a third of this noise.
    """
    rng = np.random.default_rng(seed)

    def body(t: Floats) -> Floats:
        q = np.broadcast_to(rotation.IDENTITY, (len(t), 4))
        for axis in range(3):
            angle = amplitude[axis] * np.sin(rate[axis] * t + np.sin(slow[axis] * t) + phase[axis])
            q = rotation.multiply(q, rotation.exp(angle[:, None] * np.eye(3)[axis]))
        return q

    amplitude, rate = rng.uniform(0.5, 1.1, 3), rng.uniform(2.5, 6.0, 3)
    slow, phase = rng.uniform(0.3, 1.2, 3), rng.uniform(0, 6, 3)
    t_ref = np.arange(rng.uniform(0, 1 / 120), seconds, 1 / 120)
    t_imu = np.arange(rng.uniform(0, 0.01), seconds, 0.01)
    spread = np.radians(noise)
    q_ref, q_imu = body(t_ref), body(t_imu)
    q_ref = rotation.multiply(q_ref, rotation.exp(rng.normal(scale=spread, size=(len(q_ref), 3))))
    q_imu = rotation.multiply(
        q_imu, rotation.exp(rng.normal(scale=spread / 3, size=(len(q_imu), 3)))
    )
    stamps = np.rint(1e9 * (t_imu * (1.0 + drift)) + lag_ms * NS_PER_MS).astype(np.int64)
    return LagTracks(stamps, q_imu, np.rint(1e9 * t_ref).astype(np.int64), q_ref)


def estimate_between(
    tracks: LagTracks, low_s: float, high_s: float, settings: LagSettings | None = None
) -> LagEstimate:
    t_imu, q_imu, t_ref, q_ref = tracks
    low, high = low_s * 1e9, high_s * 1e9
    near = (t_imu >= low - 3e8) & (t_imu <= high + 3e8)
    seen = (t_ref >= low) & (t_ref <= high)
    origin = int(low)
    return estimate_lag_of_rates(
        rates_from_orientations(t_imu[near], q_imu[near], origin),
        rates_from_orientations(t_ref[seen], q_ref[seen], origin),
        settings,
    )


def sigma(_: Path) -> list[Result]:
    """Measure the ratio of the lag error to its predicted sd, at five levels of optical noise.

    Each level has 32 independent windows. The simulated stamps are exact.
    """
    exact = LagSettings(stamp_sd_ns=0.0)
    figures = []
    for noise in (0.05, 0.1, 0.2, 0.3, 0.5):
        ratios = []
        for seed in range(32):
            found = estimate_between(made_up(seed, 10.0, 5.0, noise=noise), 0.4, 9.6, exact)
            if found.refused is None:
                ratios.append((found.lag_ns / NS_PER_MS - 5.0) / (found.sigma_ns / NS_PER_MS))
        label = f"noise of {noise:g}°, {len(ratios)} windows"
        spread = float(np.std(ratios))
        figures.append(Result(f"{label}: standard deviation", spread, 1.5, 0.5, "sd"))
        figures += median_and_worst(
            f"{label}: error", np.abs(ratios).tolist(), "sd", maximum=MOST_SIGMAS
        )
    return figures


def track(drift: float, seed: int) -> tuple[float, float]:
    """Return the estimated drift over two minutes and its predicted sd, both in ppm."""
    tracks = made_up(seed, 121.0, 5.0, drift=drift)
    tracker, tracked = LagTracker(), None
    for start_s in np.arange(0.4, 110.0, 2.5):
        estimate = estimate_between(tracks, start_s, start_s + 10.0)
        tracked = tracker.feed(round((start_s + 5.0) * 1e9), estimate)
    if tracked is None:
        return float("nan"), float("nan")
    return 1e6 * tracked.drift, 1e6 * tracked.drift_sigma


def drift(_: Path) -> list[Result]:
    """Check that two minutes of data yield drifts of 0, 1 and -1 ppm within two predicted sd."""
    figures = []
    for truth, seed in ((0.0, 1), (0.0, 2), (1.0, 3), (-1.0, 4)):
        found, sd = track(truth * 1e-6, seed)
        off = abs(found - truth) / sd
        figures.append(
            Result(
                f"{truth:g} ppm, run {seed}: error",
                off,
                2.0,
                unit="sd",
                note=f"estimate {found:.2f} ± {sd:.2f} ppm",
            )
        )
    return figures


def cost(data: Path) -> list[Result]:
    """Measure the CPU time of a lag estimate from 10 s of data, and of an update of the tracker.

    The data have 120 Hz (cameras) and 286 Hz (gyroscope). The first result is the median of nine
    estimates. The CPU time of this thread is measured, so other processes hardly affect it.
    """
    recording = excerpt(data, FAST)
    part = (recording.t_ns > 10e9) & (recording.t_ns < 20e9)
    ref_t = np.arange(10e9 + 1e6, 20e9, 1e9 / 120)
    ref_q = between(recording, ref_t)
    took = []
    estimate = LagEstimate(np.nan, np.inf, np.nan, "none yet")
    for _ in range(9):
        began = time.thread_time()
        imu = rates_from_gyro(recording.t_ns[part], recording.gyro[part], 0)
        ref = rates_from_orientations(np.rint(ref_t).astype(np.int64), ref_q, 0)
        estimate = estimate_lag_of_rates(imu, ref)
        took.append(time.thread_time() - began)
    tracker = LagTracker()
    began = time.thread_time()
    for k in range(1000):
        tracker.feed(k * 2_500_000_000, estimate)
    update = 1e6 * (time.thread_time() - began) / 1000
    return [
        Result("lag fit of a 10 s window", 1e3 * float(np.median(took)), 50.0, unit="ms"),
        Result("tracker update", update, 100.0, unit="µs"),
    ]


def ordinary(data: Path) -> list[Result]:
    """Measure the lag errors of 10 s windows of vigorous and of ordinary motion.

    In addition, count the windows that are accepted although the sensor rests.
    """
    figures = []
    for name, label, goal in ((FAST, "vigorous", 0.02), (SLOW, "ordinary", 0.14)):
        recording = excerpt(data, name)
        tries = [windows(recording, 10.0, seed=seed) for seed in (6, 7, 8, 9)]
        lags = np.array([one.lag_ms for found in tries for one in found if one.used])
        figures += [
            Result(
                f"{label}, standard deviation of 10 s windows",
                float(lags.std()),
                goal,
                unit="ms",
                note=f"{len(lags)} windows",
            ),
            *median_and_worst(
                f"{label}, error of 10 s windows", np.abs(lags - HALF_FRAME_MS).tolist(), "ms"
            ),
        ]
    recording = whole(data, SLOW)
    rest = recording.t_ns < 30e9
    still = Recording(recording.t_ns[rest], recording.gyro[rest], recording.optical[rest])
    used = sum(one.used for one in windows(still, 5.0))
    figures.append(Result("windows accepted at rest", float(used), 0.0, unit=""))
    return figures


EXCERPTS, WHOLE, NEED = ("broad_excerpts",), ("broad",), ("h5py",)
EXPERIMENTS = (
    Experiment(
        "lag-ten-second-windows",
        "Error of the lag from ten seconds of motion",
        ordinary,
        BOARD,
        EXCERPTS + WHOLE,
        NEED,
        headline=True,
    ),
    Experiment(
        "lag-uncertainty-simulated",
        "Stated standard deviation of the lag compared with the scatter of the errors, simulated",
        sigma,
        SEEDED,
    ),
    Experiment(
        "lag-drift",
        "Error of the estimated drift of the lag over two minutes",
        drift,
        SEEDED,
    ),
    Experiment(
        "lag-fit-time",
        "CPU time of the lag estimate",
        cost,
        BOARD,
        EXCERPTS,
        timed=True,
    ),
    Experiment(
        "lag-fast-excerpt",
        "Error of the lag, one minute of the fast trial",
        partial(excerpts, FAST, FAST_SD_MS, (4.17, 0.05)),
        BOARD,
        EXCERPTS,
    ),
    Experiment(
        "lag-slow-excerpt",
        "Error of the lag, one minute of the slow trial",
        partial(excerpts, SLOW, SLOW_SD_MS, (4.05, 0.2)),
        BOARD,
        EXCERPTS,
    ),
    Experiment(
        "lag-uncertainty-recorded",
        "Largest ratio of the lag error to its standard deviation, windows of whole trials",
        honest,
        BOARD,
        WHOLE,
        NEED,
        long=True,
    ),
    Experiment(
        "lag-orientation-input",
        "Time by which the orientations of a filter lead its gyroscope",
        quaternion_input,
        BOARD,
        EXCERPTS,
    ),
)
