"""Lag estimates: accuracy on real data, coverage of sigma, and refusal without information."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.subjects.gyro_rates import rates_from_gyro
from jointfit_daemon.timing.lag import (
    LagEstimate,
    LagSettings,
    LagTracker,
    estimate_lag,
    estimate_lag_of_rates,
    rates_from_orientations,
)
from jointfit_daemon.timing.lag._angular_rates import Interpolant, Rates

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

MS = 1_000_000
EXPECTED_MS = {"02_undisturbed_slow_rotation_B_60s": (4.05, 0.20, 0.30)}
EXPECTED_MS["07_undisturbed_fast_rotation_B_60s"] = (4.17, 0.05, 0.10)
"""By recording, ms: lag, its tolerance, and the largest sd of the lags of parts of about 10 s."""


class Excerpt(NamedTuple):
    name: str
    t_ns: NDArray[np.int64]
    gyro: NDArray[np.float64]
    optical: NDArray[np.float64]

    def rates(self, start: int = 0, stop: int | None = None) -> tuple[Rates, Rates]:
        part = slice(start, stop)
        return (
            rates_from_gyro(self.t_ns[part], self.gyro[part], 0),
            rates_from_orientations(self.t_ns[part], self.optical[part], 0),
        )


@pytest.fixture(params=sorted(EXPECTED_MS))
def excerpt(request: pytest.FixtureRequest, shared_data: Path) -> Excerpt:
    with np.load(shared_data / "broad_excerpts" / f"{request.param}.npz") as file:
        t_ns = np.rint(np.arange(len(file["imu_gyr"])) * 7e9 / 2000).astype(np.int64)
        gyro, optical = file["imu_gyr"].astype(float), file["opt_quat"].astype(float)
        return Excerpt(request.param, t_ns, gyro, optical)


# --- the real recordings ----------------------------------------------------------------------


def test_the_known_lag_of_a_real_recording_is_found(excerpt: Excerpt) -> None:
    lag, tolerance, _ = EXPECTED_MS[excerpt.name]
    estimate = estimate_lag_of_rates(*excerpt.rates())
    assert estimate.refused is None
    assert estimate.lag_ns / MS == pytest.approx(lag, abs=tolerance)
    assert estimate.r2 > 0.997
    assert 2 * np.arccos(estimate.q_imu_ref[0]) < np.radians(0.2)


def test_a_rate_stamped_at_the_left_sample_would_be_detected(excerpt: Excerpt) -> None:
    imu, ref = excerpt.rates()
    lag, tolerance, _ = EXPECTED_MS[excerpt.name]
    wrong = replace(ref, t_s=ref.t_s - ref.period_s / 2)
    off = estimate_lag_of_rates(imu, wrong).lag_ns / MS - lag
    assert off == pytest.approx(1.75, abs=tolerance)


def test_ten_seconds_at_camera_rate_suffice(excerpt: Excerpt) -> None:
    """The lag of 12 parts of a recording, with cameras at 120 Hz, random phase and random lag."""
    rng = np.random.default_rng(7)
    optical = Rotation.from_quat(excerpt.optical, scalar_first=True)
    found, sigmas = [], []
    for start in range(3, 48, 4):
        stamps = np.arange(start + rng.uniform(0, 1 / 120), start + 10, 1 / 120) * 1e9
        at = np.searchsorted(excerpt.t_ns, stamps) - 1
        share = (stamps - excerpt.t_ns[at]) / (excerpt.t_ns[at + 1] - excerpt.t_ns[at])
        step = (optical[at].inv() * optical[at + 1]).as_rotvec() * share[:, None]
        ref_q = (optical[at] * Rotation.from_rotvec(step)).as_quat(scalar_first=True)
        injected = round(rng.uniform(-50, 50) * MS)
        near = (excerpt.t_ns > stamps[0] - 3e8) & (excerpt.t_ns < stamps[-1] + 3e8)
        imu = rates_from_gyro(excerpt.t_ns[near] + injected, excerpt.gyro[near], 0)
        ref = rates_from_orientations(stamps.astype(np.int64), ref_q, 0)
        estimate = estimate_lag_of_rates(imu, ref)
        assert estimate.refused is None
        found.append((estimate.lag_ns - injected) / MS)
        sigmas.append(estimate.sigma_ns / MS)
    lag, tolerance, spread = EXPECTED_MS[excerpt.name]
    assert np.mean(found) == pytest.approx(lag, abs=tolerance)
    assert np.std(found) < spread
    # The parts overlap, so their lags may differ less than their standard deviations suggest.
    assert 0.2 < np.std(found) / np.median(sigmas) < 1.5


def test_gaps_do_not_move_the_lag(excerpt: Excerpt) -> None:
    imu, ref = excerpt.rates()
    holes = excerpt.optical.copy()
    holes[np.arange(len(holes)) % 286 < 14] = np.nan  # 50 ms in every second
    gappy = rates_from_orientations(excerpt.t_ns, holes, 0)
    whole = estimate_lag_of_rates(imu, ref)
    estimate = estimate_lag_of_rates(imu, gappy)
    assert estimate.refused is None
    assert estimate.lag_ns == pytest.approx(whole.lag_ns, abs=0.05 * MS)


def test_integrated_orientations_lead_the_gyroscope(excerpt: Excerpt) -> None:
    """Integrated orientations lead the gyroscope by half a sample, so the two lags differ."""
    steps = Rotation.from_rotvec(excerpt.gyro * 7 / 2000)
    path = [Rotation.identity()]
    for step in steps[571:4000]:
        path.append(path[-1] * step)
    imu_q = Rotation.concatenate(path[1:]).as_quat(scalar_first=True)
    part = slice(571, 4000)
    t_ns, optical = excerpt.t_ns[part], excerpt.optical[part]
    estimate = estimate_lag(t_ns, imu_q, t_ns, optical)
    gyro = estimate_lag_of_rates(*excerpt.rates(571, 4000))
    assert estimate.refused is None
    assert (gyro.lag_ns - estimate.lag_ns) / MS == pytest.approx(1.75, abs=0.1)


@pytest.mark.parametrize(("scale", "tolerance"), [(1.02, 0.02), (0.95, 0.05)])
def test_a_wrong_gyro_scale_does_not_move_the_lag(
    excerpt: Excerpt, scale: float, tolerance: float
) -> None:
    imu, ref = excerpt.rates()
    estimate = estimate_lag_of_rates(replace(imu, w=imu.w * scale), ref)
    assert estimate.lag_ns == pytest.approx(
        estimate_lag_of_rates(imu, ref).lag_ns, abs=tolerance * MS
    )


def test_no_lag_is_estimated_at_rest(excerpt: Excerpt) -> None:
    refused = estimate_lag_of_rates(*excerpt.rates(0, 560)).refused
    assert refused is not None
    assert "too little motion" in refused


def test_wrong_conventions_are_refused(excerpt: Excerpt) -> None:
    imu, ref = excerpt.rates()
    conjugated = rates_from_orientations(excerpt.t_ns, excerpt.optical * [1, -1, -1, -1], 0)
    body = Rotation.from_quat(excerpt.optical[:-1], scalar_first=True)
    world = replace(ref, w=body.apply(ref.w))
    for wrong in (conjugated, world):
        assert estimate_lag_of_rates(imu, wrong).refused is not None


# --- simulated motion with known lag ----------------------------------------------------------


def motion(seed: int, seconds: float, rate: float = 250.0) -> Rotation:
    """Return a smooth irregular rotation, sampled every 0.5 ms from t = 0."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 0.0005)
    w = sum(
        np.outer(np.sin(2 * np.pi * f * t + p), rng.normal(size=3))
        for f, p in zip(rng.uniform(0.2, 3, 8), rng.uniform(0, 6, 8), strict=True)
    )
    w *= np.radians(rate) / np.sqrt(np.mean(np.sum(w**2, axis=1)))
    q = np.array([0.0, 0.0, 0.0, 1.0])
    path = np.empty((len(t), 4))
    for k, step in enumerate(Rotation.from_rotvec(w * 0.0005).as_quat()):
        path[k] = q
        x, y, z, s = q
        a, b, c, d = step
        q = np.array(
            [
                s * a + x * d + y * c - z * b,
                s * b - x * c + y * d + z * a,
                s * c + x * b - y * a + z * d,
                s * d - x * a - y * b - z * c,
            ]
        )
        q /= np.sqrt(q @ q)
    return Rotation.from_quat(path)


def sampled(
    body: Rotation, period_ns: int, phase_ns: int, noise: float, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    t = np.arange(phase_ns, (len(body) - 2) * 500_000, period_ns)
    q = body[t // 500_000]
    q = q * Rotation.from_rotvec(rng.normal(scale=noise, size=(len(t), 3)))
    return t, q.as_quat(scalar_first=True)


MOUNT = Rotation.from_rotvec([0.4, -0.9, 0.3])
ROOM = Rotation.from_rotvec([0.0, 0.0, 1.2])


class Tracks(NamedTuple):
    imu_t: NDArray[np.int64]
    imu_q: NDArray[np.float64]
    ref_t: NDArray[np.int64]
    ref_q: NDArray[np.float64]


def made_up(seed: int, lag_ns: int, *, noise: float = 0.002, seconds: float = 12.0) -> Tracks:
    rng = np.random.default_rng(seed)
    body = motion(seed, seconds)
    ref_t, ref_q = sampled(body, 8_500_000, 1_500_000, noise, rng)
    imu_t, imu_q = sampled(ROOM * body * MOUNT.inv(), 10_000_000, 3_000_000, noise / 2, rng)
    return Tracks(imu_t + lag_ns, imu_q, ref_t, ref_q)


@pytest.mark.parametrize("lag_ms", [-60, 0, 37])
def test_lag_and_mount_come_from_orientations_in_different_worlds(lag_ms: int) -> None:
    estimate = estimate_lag(*made_up(3, lag_ms * MS))
    assert estimate.refused is None
    assert estimate.lag_ns / MS == pytest.approx(lag_ms, abs=0.3)
    found = Rotation.from_quat(estimate.q_imu_ref, scalar_first=True)
    assert (found * MOUNT.inv()).magnitude() < np.radians(0.3)


def test_either_stream_may_be_the_faster_one() -> None:
    imu_t, imu_q, ref_t, ref_q = made_up(4, 12 * MS)
    there, back = estimate_lag(imu_t, imu_q, ref_t, ref_q), estimate_lag(ref_t, ref_q, imu_t, imu_q)
    assert there.lag_ns == pytest.approx(-back.lag_ns, abs=2 * there.sigma_ns)
    assert np.linalg.norm(np.add(there.bias, Rotation.from_quat(
        there.q_imu_ref, scalar_first=True).apply(back.bias))) < 0.02  # fmt: skip


def test_errors_are_consistent_with_sigma() -> None:
    """Over 16 simulated movements, the standard deviation of error / sigma is about one."""
    ratios = []
    for seed in range(16):
        estimate = estimate_lag(*made_up(seed, 5 * MS, noise=0.004, seconds=6.0))
        ratios.append((estimate.lag_ns - 5 * MS) / estimate.sigma_ns)
    assert 0.5 < np.std(ratios) < 1.5


def test_single_missing_samples_are_bridged() -> None:
    imu_t, imu_q, ref_t, ref_q = made_up(5, 9 * MS)
    keep = np.random.default_rng(0).random(len(imu_t)) > 0.02
    estimate = estimate_lag(imu_t[keep], imu_q[keep], ref_t, ref_q)
    whole = estimate_lag(imu_t, imu_q, ref_t, ref_q)
    assert estimate.refused is None
    assert estimate.pairs > 0.95 * whole.pairs
    assert estimate.lag_ns == pytest.approx(whole.lag_ns, abs=0.1 * MS)


def test_conjugated_orientations_are_refused_and_named() -> None:
    imu_t, imu_q, ref_t, ref_q = made_up(6, 0)
    estimate = estimate_lag(imu_t, imu_q, ref_t, ref_q * [1, -1, -1, -1])
    assert estimate.refused is not None
    assert "conjugated" in estimate.refused


def test_unrelated_motion_and_far_lags_are_refused() -> None:
    imu_t, imu_q, _, _ = made_up(7, 0)
    _, _, ref_t, ref_q = made_up(8, 0)
    assert estimate_lag(imu_t, imu_q, ref_t, ref_q).refused is not None
    assert estimate_lag(imu_t + 10**12, imu_q, ref_t, ref_q).refused == "the tracks do not overlap"
    assert estimate_lag(imu_t[:0], imu_q[:0], ref_t, ref_q).refused == "no data"
    unseen = np.full_like(ref_q, np.nan)
    assert estimate_lag(imu_t, imu_q, ref_t, unseen).refused is not None


def test_a_wide_search_finds_a_lag_of_seconds() -> None:
    estimate = estimate_lag(*made_up(9, 1800 * MS), settings=LagSettings(span_s=3.0))
    assert estimate.refused is None
    assert estimate.lag_ns / MS == pytest.approx(1800, abs=0.3)


def test_periodic_motion_is_ambiguous_in_a_wide_search() -> None:
    t = np.arange(0, 12, 0.01)
    angle = 2.0 * np.sin(2 * np.pi * t)[:, None] * [1, 0, 0]
    q = Rotation.from_rotvec(angle).as_quat(scalar_first=True)
    t_ns = (t * 1e9).astype(np.int64)
    refused = estimate_lag(t_ns, q, t_ns, q, LagSettings(span_s=3.0)).refused
    assert refused is not None
    assert "periodic" in refused
    # The default span excludes lags that differ by a period.
    assert estimate_lag(t_ns, q, t_ns, q).refused is None


@pytest.mark.parametrize("span_s", [0.5, 1.0, 3.0])
def test_rounding_does_not_decide_the_rejection_of_periodic_motion(span_s: float) -> None:
    # The magnitude repeats every 0.5 s, so the correlation at the border of each search equals that
    # at zero.
    t = np.arange(0, 12, 0.01)
    t_ns = (t * 1e9).astype(np.int64)
    angle = 2.0 * np.sin(2 * np.pi * t)[:, None] * [1, 0, 0]
    refusals = set()
    for seed in range(8):
        rounding = np.random.default_rng(seed).normal(scale=1e-12, size=angle.shape)
        q = Rotation.from_rotvec(angle + rounding).as_quat(scalar_first=True)
        estimate = estimate_lag(t_ns, q, t_ns, q, LagSettings(span_s=span_s))
        refusals.add((estimate.refused, round(estimate.lag_ns / MS)))
    assert len(refusals) == 1
    refused, lag_ms = refusals.pop()
    assert lag_ms == 0
    assert refused is not None
    assert "periodic: a lag of 500 ms fits as well" in refused


def test_the_interpolant_follows_the_low_pass_band() -> None:
    t = np.arange(0, 2, 0.01)
    waves = np.stack([np.sin(2 * np.pi * f * t) for f in (1, 4, 10)], axis=1)
    track = Rates(t, waves, np.zeros(t.size, dtype=np.intp), 0.01, 1.0)
    at = np.arange(0.1, 1.9, 0.0007)
    value, slope, inside = Interpolant(track)(at)
    assert inside.all()
    for axis, f in enumerate((1, 4, 10)):
        w = 2 * np.pi * f
        assert value[:, axis] == pytest.approx(np.sin(w * at), abs=2e-3)
        assert slope[:, axis] == pytest.approx(w * np.cos(w * at), abs=0.03 * w)


# --- tracking ---------------------------------------------------------------------------------


def windows(lags_ms: list[float], sigma_ms: float, seed: int = 0) -> list[LagEstimate]:
    rng = np.random.default_rng(seed)
    return [
        LagEstimate((lag + rng.normal(scale=sigma_ms)) * MS, sigma_ms * MS, 0.999, None)
        for lag in lags_ms
    ]


def test_a_constant_lag_shows_no_drift() -> None:
    tracker, tracked = LagTracker(window_s=2.5, hop_s=2.5), None
    for k, estimate in enumerate(windows([4.0] * 48, 0.05)):
        tracked = tracker.feed(k * 2_500 * MS, estimate)
    assert tracked is not None
    assert tracked.lag_ns / MS == pytest.approx(4.0, abs=0.06)
    assert abs(tracked.drift) < 2 * tracked.drift_sigma
    assert tracked.drift_sigma < 1e-6


def test_a_step_is_reported_once_and_an_outlier_never() -> None:
    tracker = LagTracker()
    lags = [4.0] * 10 + [9.0] + [4.0] * 10 + [7.0] * 20
    steps = [
        (k, tracked.step_ns)
        for k, estimate in enumerate(windows(lags, 0.05))
        if (tracked := tracker.feed(k * 2_500 * MS, estimate)) and tracked.step_ns is not None
    ]
    assert len(steps) == 1
    number, step_ns = steps[0]
    assert number - 21 < 8  # one window every 2.5 s, so within 20 s
    assert step_ns / MS == pytest.approx(3.0, abs=0.5)


def test_overlapping_windows_are_not_counted_twice() -> None:
    last = {}
    for window in (2.5, 10.0):
        tracker = LagTracker(window_s=window, hop_s=2.5)
        for k, estimate in enumerate(windows([4.0] * 20, 0.05)):
            last[window] = tracker.feed(k * 2_500 * MS, estimate)
    apart, overlapping = last[2.5], last[10.0]
    assert apart is not None
    assert overlapping is not None
    assert overlapping.sigma_ns > 1.5 * apart.sigma_ns


def test_rejected_window_does_not_change_the_lag() -> None:
    tracker = LagTracker()
    assert tracker.feed(0, LagEstimate(0.0, 0.0, 0.0, "at rest")) is None
    before = tracker.feed(0, LagEstimate(4e6, 5e4, 0.999, None))
    after = tracker.feed(0, LagEstimate(9e6, 5e4, 0.5, "no"))
    assert before == after
