"""Alignment of streams to frames: interpolation error and latency.

Samples pass through the aligner of the daemon. The simulated body (``shaken``) rotates about three
axes at once, 550 deg/s RMS and at most 950 deg/s. ``broad`` is a recorded board that was turned by
hand, 579 deg/s RMS. The orientation of the board is its integrated angular rate. The aligner
receives every third or fifth of these orientations, and the others are the ground truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import cos, degrees, sin
from typing import TYPE_CHECKING, Literal

import numpy as np

from bench.framework.experiment import Experiment, Result
from bench.framework.material import OMITTED_SAMPLES, SIMULATED_CLOCKS
from bench.rigs.core_trace import traced, true_errors
from bench.subjects.simulated_clocks import REBOOTED, simulated
from jointfit_daemon.kinematics.rotation_scalar import (
    angle_between_one,
    exp_one,
    interpolate_one,
    multiply_one,
    normalize_one,
)
from jointfit_daemon.timing.alignment import (
    CURVATURE_SHARE,
    FrameAligner,
    extrapolate_orientation,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from jointfit_daemon.model import Quaternion, Vector
    from jointfit_daemon.timing.alignment import AlignedFrame, Mode

    Motion = Callable[[int], Quaternion]

NS, MS = 1_000_000_000, 1_000_000
BEGIN_NS = 100 * NS
FRAME_NS = 10 * MS
SECONDS = 20.0
FAST, SLOW = "07_undisturbed_fast_rotation_B", "02_undisturbed_slow_rotation_B"
_REST = 571  # samples at rest before the movement
_SWINGS = ((1.2, 1.1, 0.0), (0.9, 1.4, 1.0), (0.7, 1.7, 2.0))
"""Amplitude, rad, frequency, Hz, and phase, rad, of the rotations about z, x and y."""


def shaken(t_ns: int) -> Quaternion:
    """Return the orientation of the shaken body."""
    t = (t_ns - BEGIN_NS) / NS
    z, x, y = (a * sin(6.283185307179586 * f * t + p) / 2 for a, f, p in _SWINGS)
    about_zx = multiply_one((cos(z), 0.0, 0.0, sin(z)), (cos(x), sin(x), 0.0, 0.0))
    return multiply_one(about_zx, (cos(y), 0.0, sin(y), 0.0))


def aligned(
    period_ns: float,
    motion: Motion,
    *,
    phase_ns: int,
    frame_ns: int = FRAME_NS,
    noise: Callable[[Quaternion], Quaternion] | None = None,
) -> list[AlignedFrame]:
    """Return the frames of one stream that arrives without delay."""
    aligner = FrameAligner({"S": round(period_ns)}, frame_ns)
    frames: list[AlignedFrame] = []
    for k in range(round(SECONDS * NS / period_ns)):
        t_ns = BEGIN_NS + phase_ns + round(k * period_ns)
        q = motion(t_ns)
        aligner.push("S", t_ns, t_ns, noise(q) if noise else q)
        frames += aligner.advance(t_ns)
    return frames


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def errors_deg(frames: Sequence[AlignedFrame], motion: Motion) -> list[float]:
    """Return the error of every orientation except in the first frames, deg."""
    return [
        degrees(angle_between_one(q, motion(frame.t_ns)))
        for frame in frames[5:]
        for q in frame.orientations.values()
    ]


def slerped_deg(period_ns: float, frames: Sequence[AlignedFrame], phase_ns: int) -> float:
    """Return the RMS error of interpolation (slerp) between exact samples at these frames, deg."""
    found = []
    for frame in frames[5:]:
        k = int((frame.t_ns - BEGIN_NS - phase_ns) // period_ns)
        a, b = (BEGIN_NS + phase_ns + round(i * period_ns) for i in (k, k + 1))
        q = interpolate_one(shaken(a), shaken(b), (frame.t_ns - a) / (b - a))
        found.append(degrees(angle_between_one(q, shaken(frame.t_ns))))
    return _rms(found)


def interpolation(_data: Path) -> list[Result]:
    """Measure the interpolation error of streams of 60, 100 and 120 Hz at frames of 100 Hz.

    At 100 Hz, every frame is midway between two samples.
    """
    figures = []
    for rate_hz, goal in ((60.0, 0.025), (100.0, 0.008), (120.0, 0.004)):
        period_ns, phase_ns = NS / rate_hz, 5 * MS
        frames = aligned(period_ns, shaken, phase_ns=phase_ns)
        slerp = slerped_deg(period_ns, frames, phase_ns)
        figures += [
            Result(f"{rate_hz:g} Hz: RMS error", _rms(errors_deg(frames, shaken)), goal),
            Result(f"{rate_hz:g} Hz: slerp", slerp, float("inf")),
        ]
    dice = np.random.default_rng(3)

    def scattered(q: Quaternion) -> Quaternion:
        x, y, z = (dice.standard_normal(3) * np.radians(0.1) / np.sqrt(3)).tolist()
        return multiply_one(q, exp_one((x, y, z)))

    frames = aligned(NS / 100.0, shaken, phase_ns=5 * MS, noise=scattered)
    name = "100 Hz, samples scatter by 0.1 deg"
    return [*figures, Result(name, _rms(errors_deg(frames, shaken)), 0.1)]


# --- recorded board ----------------------------------------------------------------------------


@cache
def _board(data: Path, trial: str) -> tuple[list[Quaternion], float]:
    """Return the orientations integrated from a trial's angular rate, and their rate, Hz."""
    with np.load(data / "broad_excerpts" / f"{trial}_60s.npz", allow_pickle=False) as file:
        rate_hz = float(file["sampling_rate"])
        gyro = file["imu_gyr"][_REST:].astype(float)
    found: list[Quaternion] = [(1.0, 0.0, 0.0, 0.0)]
    for x, y, z in (gyro[1:] / rate_hz).tolist():
        found.append(normalize_one(multiply_one(found[-1], exp_one((x, y, z)))))
    return found, rate_hz


def _left_out_rms(truth: Sequence[Quaternion], rate_hz: float, step: int) -> float:
    """Return the RMS error at the omitted samples, deg; every `step`-th sample is used."""
    period_ns = round(NS / rate_hz)  # one frame per original sample
    begin_ns = -(-BEGIN_NS // period_ns) * period_ns

    def motion(t_ns: int) -> Quaternion:
        return truth[(t_ns - begin_ns) // period_ns]

    phase_ns = begin_ns - BEGIN_NS
    frames = aligned(step * period_ns, motion, phase_ns=phase_ns, frame_ns=period_ns)
    between = [frame for frame in frames if (frame.t_ns - begin_ns) // period_ns % step]
    return _rms(errors_deg(between, motion))


def board(data: Path) -> list[Result]:
    """Measure the interpolation error with every third or fifth sample of a recorded board.

    The omitted samples are the ground truth.
    """
    figures = []
    for trial, name, goals in ((FAST, "fast", (0.03, 0.12)), (SLOW, "slow", (0.008, 0.025))):
        truth, rate_hz = _board(data, trial)
        for step, goal in zip((3, 5), goals, strict=True):
            error = _left_out_rms(truth, rate_hz, step)
            figures.append(Result(f"{name}, {rate_hz / step:.0f} Hz: RMS error", error, goal))
    return figures


# --- extrapolation ------------------------------------------------------------------------------


@dataclass(slots=True)
class _TimedOrientation:
    t_ns: int
    q: Quaternion
    rate: Vector | None = None
    turn: Vector | None = None


def _ahead_rms(
    truth: Sequence[Quaternion], rate_hz: float, scatter_rad: float, bend: float
) -> float:
    """Return the RMS error of extrapolation by up to one period of the used samples, deg.

    Every third sample is used, with a random error of RMS `scatter_rad`. `bend` is the share of the
    estimated angular acceleration that the extrapolation uses.
    """
    dice, period_ns = np.random.default_rng(5), round(NS / rate_hz)
    samples = []
    for k in range(0, len(truth), 3):
        x, y, z = (dice.standard_normal(3) * scatter_rad / np.sqrt(3)).tolist()
        samples.append(_TimedOrientation(k * period_ns, multiply_one(truth[k], exp_one((x, y, z)))))
    found = []
    for last in range(2, len(samples) - 1):
        for ahead in (1, 2, 3):
            k = 3 * last + ahead
            earlier, before, a = samples[last - 2 : last + 1]
            q = extrapolate_orientation(earlier, before, a, k * period_ns, bend)
            found.append(degrees(angle_between_one(q, truth[k])))
    return _rms(found)


def ahead(data: Path) -> list[Result]:
    """Measure the errors of extrapolation with different shares of the angular acceleration.

    The shares are 0, `CURVATURE_SHARE` (as in the daemon) and 1.
    """
    figures = []
    for trial, name, scatter_deg, goal in (
        (FAST, "fast", 0.0, 0.45),
        (FAST, "fast, scatter 0.3 deg", 0.3, 0.9),
        (SLOW, "slow, scatter 0.03 deg", 0.03, 0.1),
    ):
        truth, rate_hz = _board(data, trial)
        straight, bent, full = (
            _ahead_rms(truth, rate_hz, np.radians(scatter_deg), bend)
            for bend in (0.0, CURVATURE_SHARE, 1.0)
        )
        figures += [
            Result(f"{name}: damped", bent, goal),
            Result(f"{name}: constant rate", straight, float("inf")),
            Result(f"{name}: constant acceleration", full, float("inf")),
        ]
    return figures


# --- latency ----------------------------------------------------------------------------------

STREAMS = {"S1": (1.3, 2.0), "S2": (3.7, 1.0), "S3": (6.1, 2.0), "S4": (8.8, 1.0)}
"""Phase and minimum delay of each stream, ms: two on UART, two on CAN, all at 100 Hz."""


def four(mode: Mode, seed: int = 7) -> list[AlignedFrame]:
    """Return the frames of `STREAMS` with an additional exponential delay, on average 0.5 ms."""
    dice = np.random.default_rng(seed)
    arrivals: list[tuple[int, str, int]] = []
    for name, (phase_ms, least_ms) in STREAMS.items():
        taken = BEGIN_NS + round(phase_ms * MS) + FRAME_NS * np.arange(round(SECONDS * 100))
        delay = least_ms * MS + dice.exponential(0.5 * MS, len(taken))
        arrived = np.maximum.accumulate(taken + delay.astype(np.int64))
        arrivals += [(at, name, t) for at, t in zip(arrived.tolist(), taken.tolist(), strict=True)]
    aligner = FrameAligner(dict.fromkeys(STREAMS, FRAME_NS), FRAME_NS, mode=mode)
    frames: list[AlignedFrame] = []
    for at_ns, name, t_ns in sorted(arrivals):
        while (due_ns := aligner.next_deadline_ns) is not None and due_ns < at_ns:
            frames += aligner.advance(due_ns)
        aligner.push(name, t_ns, at_ns, shaken(t_ns))
        frames += aligner.advance(at_ns)
    return frames


def latency(_data: Path) -> list[Result]:
    """Measure the time from the instant of a frame to its completion, and orientation errors."""
    figures = []
    goals: dict[Literal["smooth", "fast"], tuple[float, float, float]] = {
        "smooth": (10.5, 13.0, 0.006),
        "fast": (0.5, 3.0, 0.2),
    }
    for mode, (median_ms, most_ms, error_deg) in goals.items():
        frames = four(mode)
        waited = [(frame.completed_ns - frame.t_ns) / MS for frame in frames[10:]]
        figures += [
            Result(f"{mode}: latency, median", float(np.median(waited)), median_ms, unit="ms"),
            Result(f"{mode}: latency, 99 %", float(np.quantile(waited, 0.99)), most_ms, unit="ms"),
            Result(f"{mode}: error, RMS", _rms(errors_deg(frames, shaken)), error_deg),
        ]
    return figures


# --- synchronization flag -----------------------------------------------------------------------


def honesty(_data: Path) -> list[Result]:
    """Measure the errors of samples and frames that are flagged as synchronized.

    One sensor reboots, and another is silent for half a second.
    """
    run = simulated(30.0)
    trace = traced(run.events)
    errors = true_errors(trace, run.taken_ns, run.unseen_ns)
    sensors = {name: found for name, found in errors.items() if name != "mocap"}
    worst_ms = max(float(np.abs(error[synced]).max()) for _, error, synced in sensors.values())
    t_s, _, synced = sensors[REBOOTED]
    gone_s = run.incidents[f"{REBOOTED} reboots"]
    back_s = float(t_s[t_s > gone_s][0])
    settled_s = float(t_s[synced & (t_s > gone_s)][0])
    unfit = [
        frame
        for frame in trace.frames
        if frame.synced
        and not frame.missing
        and gone_s + 0.1 < (frame.t_ns - trace.begin_ns) / NS < settled_s - 0.02
    ]
    first_s = next((f.t_ns - trace.begin_ns) / NS for f in trace.frames if f.synced)
    return [
        Result("largest error of a sample flagged synchronized", worst_ms, 0.2, unit="ms"),
        Result("first synchronized frame after the start", first_s, 3.5, unit="s"),
        Result("synchronized again after the reboot", settled_s - back_s, 5.0, unit="s"),
        Result(
            "synchronized frames with the rebooted sensor before that",
            float(len(unfit)),
            0.0,
            unit="",
        ),
    ]


EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment(
        "interpolation-shaken",
        "Error of the interpolation of a body that is shaken at 550 °/s RMS",
        interpolation,
        SIMULATED_CLOCKS,
    ),
    Experiment(
        "interpolation-recorded-board",
        "Error of the interpolation of a recorded board",
        board,
        OMITTED_SAMPLES,
        ("broad_excerpts",),
    ),
    Experiment(
        "extrapolation-recorded-board",
        "Error of extrapolation by up to one sample period at 95 Hz, recorded board",
        ahead,
        OMITTED_SAMPLES,
        ("broad_excerpts",),
    ),
    Experiment(
        "alignment-latency",
        "Latency added by the alignment of four shaken IMUs at 100 Hz",
        latency,
        SIMULATED_CLOCKS,
    ),
    Experiment(
        "synchronization-flags",
        "Errors of samples and frames that are flagged as synchronized",
        honesty,
        SIMULATED_CLOCKS,
        headline=True,
    ),
)
