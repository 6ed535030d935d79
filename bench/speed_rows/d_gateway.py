"""From the pty to the subscriber: latency, CPU share, memory, start, samples unaccounted for."""

from __future__ import annotations

import asyncio
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from bench.gateway import Figures, Load, run
from bench.harness import Bench, Row, percentile
from jointfit_daemon.tools.embedded_broker import embedded_broker
from tests.broker_fixture import EmbeddedBroker, MosquittoBroker

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

SECONDS, QUICK_S = 20.0, 4.0


@contextmanager
def _mosquitto(folder: Path) -> Iterator[int]:
    broker = MosquittoBroker(folder)
    broker.start()
    try:
        yield broker.port
    finally:
        broker.stop()


def _played(broker: str, load: Load, quick: bool) -> Figures | None:
    needed = MosquittoBroker if broker == "mosquitto" else EmbeddedBroker
    if (reason := needed.missing()) is not None:
        print(f"not run: {reason}", file=sys.stderr)
        return None
    with tempfile.TemporaryDirectory(prefix="jointfit-bench-") as temporary:
        folder = Path(temporary)
        with (_mosquitto if broker == "mosquitto" else embedded_broker)(folder) as port:
            return asyncio.run(run(folder, port, load, QUICK_S if quick else SECONDS))


def _latency(name: str, found: Figures, goal_p99_ms: float) -> list[Row]:
    ms = found.latencies_ms
    middle, worst = percentile(ms, 0.5), percentile(ms, 0.99)
    note = f"{len(ms)} frames, longest {max(ms):.1f} ms"
    return [
        Row(f"{name}: latency, median", round(middle, 2), "ms", goal_p99_ms / 4, 10 * goal_p99_ms),
        Row(
            f"{name}: latency, p99",
            round(worst, 2),
            "ms",
            goal_p99_ms,
            20 * goal_p99_ms,
            None,
            note,
        ),
    ]


def _cost(name: str, found: Figures, goal_percent: float | None) -> list[Row]:
    share = 100 * found.cpu_s / found.seconds
    frame_s = found.cpu_s / max(1, len(found.latencies_ms))
    floor = None if goal_percent is None else 5 * goal_percent
    waited = 100 * found.waited_s / found.seconds
    note = f"{1e6 * frame_s:.0f} µs a frame; ready and without a core {waited:.1f} % of the time"
    return [
        Row(
            f"{name}: CPU of the daemon",
            round(share, 1),
            "% of a core",
            goal_percent,
            floor,
            round(frame_s / found.loop_s, 2),
            note,
        ),
        Row(f"{name}: memory of the daemon", round(found.rss_mb, 1), "MB", 100, 250),
    ]


def _honest(name: str, found: Figures) -> Row:
    note = f"of {found.received}"
    return Row(f"{name}: samples unaccounted for", found.unaccounted, "", 0, 0, None, note)


def _through(rate_hz: float, goal_percent: float | None) -> Callable[[bool], list[Row]]:
    def measured(quick: bool) -> list[Row]:
        found = _played("mosquitto", Load(rate_hz), quick)
        if found is None:
            return []
        name = f"4 × {rate_hz:g} Hz"
        return [
            *_latency(name, found, 20.0),
            *_cost(name, found, goal_percent),
            _honest(name, found),
            *(_start(found) if rate_hz == 100.0 else []),
        ]

    return measured


def _start(found: Figures) -> list[Row]:
    return [
        Row("start: exec to online at the broker", round(found.running_s, 2), "s", 1.0, 8.0),
        Row("start: exec to first pose", round(found.first_pose_s, 2), "s", 2.0, 15.0),
    ]


def embedded_rows(quick: bool) -> list[Row]:
    found = _played("iotcore", Load(100.0, 120.0), quick)
    return [] if found is None else _latency("demo's broker, 4 × 100 Hz", found, 60.0)


BENCHES = (
    Bench("gateway100", "processes: 4 × 100 Hz and 100 Hz mocap, mosquitto", _through(100.0, None)),
    Bench("gateway200", "processes: 4 × 200 Hz and 100 Hz mocap, mosquitto", _through(200.0, 10.0)),
    Bench("gateway400", "processes: 4 × 400 Hz and 100 Hz mocap, mosquitto", _through(400.0, None)),
    Bench("embedded", "processes: the demo's broker", embedded_rows),
)
