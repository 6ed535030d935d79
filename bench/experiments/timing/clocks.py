"""Conversion of device clocks to host time, simulated with the delays of each transport.

The clock of a camera server is fitted to echoes. An echo is a request to the server, whose answer
contains the server's time. The clocks of sensors are fitted to the arrival times of samples.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import Experiment, Result, median_and_worst
from bench.framework.material import SIMULATED_CLOCKS
from jointfit_daemon.model import ClockEcho, TickClock
from jointfit_daemon.timing.clock import DeviceClock

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    Delays = Callable[[np.random.Generator, int], NDArray[np.float64]]
    Figures = Callable[[], list[Result]]

MS, S = 1_000_000, 1_000_000_000
PERIOD = 10 * MS
START = 7_000 * S
SKEW = 40e-6
MICROSECONDS = TickClock(1000, 1 << 32)
SERVER_HZ = 10_000_000
SERVER = TickClock(1, None, SERVER_HZ)
SERVER_SKEW = 42e-6


def exponential(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Return delays on a UART, ns, with an exponential distribution of mean 0.3 ms."""
    return rng.exponential(3e5, n)


def spiky(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Return the delays of `exponential`, ns, of which 2 % have an additional 5 to 20 ms."""
    return rng.exponential(3e5, n) + (rng.random(n) < 0.02) * rng.uniform(5e6, 20e6, n)


def usb_polling(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Return delays on a bus that is polled every millisecond, ns."""
    return rng.uniform(0, 1e6, n) + rng.exponential(5e4, n)


def latency_timer(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    """Return delays of a USB bridge with a latency timer of 16 ms, ns."""
    return rng.uniform(0, 16e6, n)


def passive_run(
    seed: int, delays: Delays, seconds: float
) -> tuple[NDArray[np.float64], DeviceClock, NDArray[np.float64]]:
    """Return errors of all stamps, ms, the final clock, and predicted sd of all stamps, ms."""
    rng, clock = np.random.default_rng(seed), DeviceClock(PERIOD)
    n = int(seconds * S) // PERIOD
    true = START + PERIOD * np.arange(n)
    arrivals = np.maximum.accumulate(true + delays(rng, n).astype(np.int64))
    ticks = 1000 + ((true - START) / (1 + SKEW) / 1000).astype(np.int64)
    stamps = [
        clock.feed_sample(tick, None, arrival, MICROSECONDS)
        for tick, arrival in zip(ticks.tolist(), arrivals.tolist(), strict=True)
    ]
    errors = np.array([stamp.t_ns for stamp in stamps]) - true
    return errors / MS, clock, np.array([stamp.sigma_ns for stamp in stamps]) / MS


def server_ticks(t: float) -> int:
    """Return the time of the simulated server at host time `t`, ns, in ticks."""
    return int((t - START + 400 * S) * (1 + SERVER_SKEW) * (SERVER_HZ / S))


def echo_run(seed: int) -> tuple[float, float, float]:
    """Return the stamp errors after 10 echoes and after 60 s, µs, and the final skew error, ppm."""
    rng, clock = np.random.default_rng(seed), DeviceClock(PERIOD)
    now, first, error = START, 0.0, 0.0
    for number in range(70):
        there, back = 430_000 + rng.exponential(1e5, 2) + (rng.random(2) < 0.01) * 20e6
        clock.feed_echo(ClockEcho(now, int(now + there + back), server_ticks(now + there)), SERVER)
        stamp = clock.feed_sample(server_ticks(now), None, now + 6 * MS, SERVER)
        error = (stamp.t_ns - now) / 1e3
        first = error if number == 9 else first
        now += 50 * MS if number < 10 else S + int(rng.uniform(-0.2, 0.2) * S)
    return first, error, (clock.skew_ppm or 0.0) + 1e6 * SERVER_SKEW


def error_results(
    label: str, errors: NDArray[np.float64], unit: str, goals: tuple[float, float]
) -> list[Result]:
    """Return RMS and 99th percentile with their thresholds, and median and worst error of a run."""
    sizes = np.abs(errors)
    return [
        Result(f"{label}, RMS", _rms(errors), goals[0], unit=unit),
        Result(f"{label}, 99 %", float(np.quantile(sizes, 0.99)), goals[1], unit=unit),
        *median_and_worst(label, sizes.tolist(), unit),
    ]


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def echoes(_: Path, runs: int = 200) -> list[Result]:
    """Measure the errors of a clock that is fitted to echoes.

    In each direction, an echo is delayed by 0.43 ms and by an exponential delay with a mean of
    0.1 ms. In 1 % of the cases, 20 ms are added.
    """
    first, last, skew = np.array([echo_run(seed) for seed in range(runs)]).T
    return [
        *error_results("after 10 echoes", first, "µs", (22.0, 73.0)),
        *error_results("after 60 s", last, "µs", (7.5, 19.0)),
        Result("skew after 60 s, RMS", _rms(skew), 0.22, unit="ppm"),
        *median_and_worst("skew after 60 s", np.abs(skew).tolist(), "ppm"),
    ]


def passive(
    delays: Delays, seconds: float, goals: tuple[float, float], runs: int
) -> tuple[list[Result], NDArray[np.float64], NDArray[np.float64]]:
    """Return results of the final stamp errors, and two values of each run.

    These values are the final skew error, ppm, and the final stamp error divided by its predicted
    sd.
    """
    ends, skews, scaled = [], [], []
    for seed in range(runs):
        errors, clock, sigmas = passive_run(seed, delays, seconds)
        ends.append(errors[-1])
        skews.append((clock.skew_ppm or 0.0) - 1e6 * SKEW)
        scaled.append(errors[-1] / sigmas[-1])
    label = f"{delays.__name__.replace('_', ' ')}, {seconds:g} s"
    figures = error_results(label, np.array(ends), "ms", goals)
    return figures, np.array(skews), np.array(scaled)


def jitter(_: Path, runs: int = 60) -> list[Result]:
    """Measure the errors of clocks that are fitted to arrival times with usual jitter."""
    figures: list[Result] = []
    skews = np.zeros(0)
    for delays, seconds, goals in (
        (exponential, 10.0, (0.0015, 0.004)),
        (spiky, 10.0, (0.0015, 0.005)),
        (usb_polling, 10.0, (0.018, 0.045)),
        (spiky, 60.0, (0.001, 0.02)),
    ):
        found, skews, _scaled = passive(delays, seconds, goals, runs if seconds < 60 else runs // 3)
        figures += found
    sizes = np.abs(skews).tolist()
    return [*figures, *median_and_worst("skew after 60 s", sizes, "ppm", maximum=2.0)]


def timer(_: Path, runs: int = 90) -> list[Result]:
    """Measure the errors of clocks fitted to arrival times that a latency timer of 16 ms delays."""
    ten, _skews, scaled = passive(latency_timer, 10.0, (0.11, 0.25), runs)
    sixty, _skews, _scaled = passive(latency_timer, 60.0, (0.015, 0.05), runs // 3)
    ratio = "error over standard deviation"
    honest = Result(f"{ratio}, RMS", _rms(scaled), 1.5, 0.3, unit="")
    return [*ten, *sixty, honest, *median_and_worst(ratio, np.abs(scaled).tolist(), "")]


def wraps_and_restarts(_: Path) -> list[Result]:
    """Measure the errors at an overflow of every clock type, and after a reboot."""
    runs = [
        _wrapped(seed, TickClock(tick_ns, modulus))
        for tick_ns, modulus in ((1000, 1 << 32), (100_000, 1 << 32), (100_000, 864_000_000))
        for seed in range(3)
    ]
    errors, settling, early = (list(column) for column in zip(*runs, strict=True))
    return [
        *median_and_worst("error across a wrap", errors, "ms", maximum=1.0),
        *median_and_worst("settling time after a restart", settling, "s", maximum=5.0),
        Result("samples flagged synchronized with an error above 1 ms", sum(early), 0, unit=""),
    ]


def _wrapped(seed: int, clock: TickClock) -> tuple[float, float, int]:
    """Return the largest error across the overflow, ms, and two values after the reboot.

    These values are the settling time, s, and the number of stamps that are flagged as synchronized
    but have an error above 1 ms.
    """
    rng, device = np.random.default_rng(seed), DeviceClock(PERIOD)
    modulus = clock.modulus or 1
    worst, settled_at, wrong = 0.0, None, 0
    boot = START + 22 * S
    for k in range(3000):
        t = START + k * PERIOD
        again = t >= boot
        since = t - boot if again else t - START
        base = 10 if again else modulus - 15 * S // clock.tick_ns
        ticks = (base + int(since * (1 + SKEW)) // clock.tick_ns) % modulus
        arrival = t + int(rng.exponential(3e5))
        stamp = device.feed_sample(ticks, None, arrival, clock)
        off = abs(stamp.t_ns - t) / MS
        if not again and stamp.synced:
            worst = max(worst, off)
        elif again and stamp.synced:
            wrong += off > 1.0
            settled_at = (t - boot) / S if settled_at is None else settled_at
    return worst, 99.0 if settled_at is None else settled_at, wrong


def cost(_: Path) -> list[Result]:
    """Measure the time per sample including refits, best of five runs of one minute."""
    rng = np.random.default_rng(0)
    n = 6000
    best = float("inf")
    for _number in range(5):
        device = DeviceClock(PERIOD)
        true = START + PERIOD * np.arange(n)
        rows = list(
            zip(
                ((true - START) // 1000).tolist(),
                (true + rng.exponential(3e5, n)).astype(np.int64).tolist(),
                strict=True,
            )
        )
        began = time.process_time()
        for ticks, arrival in rows:
            device.feed_sample(ticks, None, arrival, MICROSECONDS)
        best = min(best, time.process_time() - began)
    return [Result("clock update, amortized", 1e6 * best / n, 5.0, unit="µs")]


EXPERIMENTS = (
    Experiment(
        "server-clock-echoes",
        "Clock of the camera server from echo requests, 200 runs",
        echoes,
        SIMULATED_CLOCKS,
    ),
    Experiment(
        "device-clock-jitter",
        "Device clock from arrival times, ordinary jitter; 60 runs of 10 s and 20 of 60 s",
        jitter,
        SIMULATED_CLOCKS,
        long=True,
    ),
    Experiment(
        "device-clock-latency-timer",
        "Device clock from arrival times, USB latency timer of 16 ms; 90 runs of 10 s and 30 of "
        "60 s",
        timer,
        SIMULATED_CLOCKS,
        long=True,
    ),
    Experiment(
        "clock-wraps-and-restarts",
        "Clock errors at a counter wrap and at a restart of a device, 9 runs",
        wraps_and_restarts,
        SIMULATED_CLOCKS,
    ),
    Experiment(
        "clock-update-time",
        "CPU time of a clock update",
        cost,
        SIMULATED_CLOCKS,
        timed=True,
    ),
)
