"""Daemon from serial port to subscriber: latency, CPU share, memory, start, lost samples."""

from __future__ import annotations

import asyncio
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from bench.framework.measurement import percentile, speed_experiment, timed_result
from bench.rigs.gateway import Figures, Load, run, run_flooded
from jointfit_daemon.tools.embedded_broker import embedded_broker
from tests.broker_fixture import EmbeddedBroker, MosquittoBroker

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator

    from bench.framework.experiment import Result

SECONDS, QUICK_S = 20.0, 4.0


@contextmanager
def running_mosquitto(folder: Path) -> Iterator[MosquittoBroker]:
    """Run mosquitto on a free port."""
    broker = MosquittoBroker(folder)
    broker.start()
    try:
        yield broker
    finally:
        broker.stop()


@contextmanager
def _mosquitto(folder: Path) -> Iterator[int]:
    with running_mosquitto(folder) as broker:
        yield broker.port


Found = TypeVar("Found")


def played(broker: str, play: Callable[[Path, int], Coroutine[Any, Any, Found]]) -> Found | None:
    """Return the result of `play` with a broker, or None if the broker is not installed."""
    needed = MosquittoBroker if broker == "mosquitto" else EmbeddedBroker
    if (reason := needed.missing()) is not None:
        print(f"not run: {reason}", file=sys.stderr)
        return None
    with tempfile.TemporaryDirectory(prefix="jointfit-bench-") as temporary:
        folder = Path(temporary)
        with (_mosquitto if broker == "mosquitto" else embedded_broker)(folder) as port:
            return asyncio.run(play(folder, port))


def _latency(name: str, ms: list[float], goal_p99_ms: float) -> list[Result]:
    middle, worst = percentile(ms, 0.5), percentile(ms, 0.99)
    note = f"{len(ms)} frames, longest {max(ms):.1f} ms"
    return [
        timed_result(
            f"{name}: latency, median", round(middle, 2), "ms", goal_p99_ms / 4, 10 * goal_p99_ms
        ),
        timed_result(
            f"{name}: latency, p99",
            round(worst, 2),
            "ms",
            goal_p99_ms,
            20 * goal_p99_ms,
            note=note,
        ),
    ]


def _cost(name: str, found: Figures, goal_percent: float | None) -> list[Result]:
    share = 100 * found.cpu_s / found.seconds
    frame_s = found.cpu_s / max(1, len(found.latencies_ms))
    floor = None if goal_percent is None else 5 * goal_percent
    waited = 100 * found.waited_s / found.seconds
    note = f"{1e6 * frame_s:.0f} µs per frame; waiting for a core {waited:.1f} % of the time"
    return [
        timed_result(
            f"{name}: CPU of the daemon",
            round(share, 1),
            "% of a core",
            goal_percent,
            floor,
            ratio=round(frame_s / found.loop_s, 2),
            note=note,
        ),
        timed_result(f"{name}: memory of the daemon", round(found.rss_mb, 1), "MB", 100, 250),
    ]


def _losses(name: str, found: Figures) -> list[Result]:
    note = f"of {found.received}"
    return [
        timed_result(f"{name}: samples unaccounted for", found.unaccounted, "", 0, 0, note=note),
        timed_result(f"{name}: samples dropped", found.dropped, "", 0, note=note),
    ]


def _through(rate_hz: float, goal_percent: float | None) -> Callable[[bool], list[Result]]:
    def measured(quick: bool) -> list[Result]:
        seconds = QUICK_S if quick else SECONDS
        found = played("mosquitto", lambda folder, port: run(folder, port, Load(rate_hz), seconds))
        if found is None:
            return []
        name = f"4 × {rate_hz:g} Hz"
        return [
            *_latency(name, found.latencies_ms, 20.0),
            *_cost(name, found, goal_percent),
            *_losses(name, found),
            *(_start(found) if rate_hz == 100.0 else []),
        ]

    return measured


def _start(found: Figures) -> list[Result]:
    return [
        timed_result(
            "start: exec to online at the broker", round(found.running_s, 2), "s", 1.0, 8.0
        ),
        timed_result("start: exec to first pose", round(found.first_pose_s, 2), "s", 2.0, 15.0),
    ]


def embedded_rows(quick: bool) -> list[Result]:
    seconds, load = QUICK_S if quick else SECONDS, Load(100.0, 120.0)
    found = played("iotcore", lambda folder, port: run(folder, port, load, seconds))
    name = "demo's broker, 4 × 100 Hz"
    return [] if found is None else _latency(name, found.latencies_ms, 60.0)


def flood_rows(quick: bool) -> list[Result]:
    """Measure one short run, first without requests and then under a flood of requests."""
    del quick
    load = Load(100.0)
    found = played("mosquitto", lambda folder, port: run_flooded(folder, port, load))
    if found is None:
        return []
    name = f"4 × 100 Hz, {found.requests} invalid requests in {found.seconds:.0f} s"
    share, quiet = found.flooded_cpu_s / found.seconds, found.quiet_cpu_s / found.seconds
    note = f"{100 * quiet:.1f} without; {found.ignored} requests ignored"
    return [
        *_latency("4 × 100 Hz, same run without requests", found.quiet_ms, 20.0),
        *_latency(name, found.flooded_ms, 20.0),
        timed_result(f"{name}: CPU of the daemon", round(100 * share, 1), "% of a core", note=note),
    ]


EXPERIMENTS = (
    speed_experiment(
        "gateway-hundred-hertz",
        "Processes: 4 × 100 Hz, optical frames at 100 Hz, mosquitto",
        _through(100.0, None),
    ),
    speed_experiment(
        "gateway-two-hundred-hertz",
        "Processes: 4 × 200 Hz, optical frames at 100 Hz, mosquitto",
        _through(200.0, 10.0),
    ),
    speed_experiment(
        "gateway-four-hundred-hertz",
        "Processes: 4 × 400 Hz, optical frames at 100 Hz, mosquitto",
        _through(400.0, None),
    ),
    speed_experiment(
        "gateway-request-flood",
        "Processes: 4 × 100 Hz during a flood of invalid requests, mosquitto",
        flood_rows,
    ),
    speed_experiment(
        "gateway-embedded-broker",
        "Processes: 4 × 100 Hz, the embedded broker of the demo",
        embedded_rows,
    ),
)
