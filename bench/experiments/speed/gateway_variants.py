"""CPU time of the running daemon with compiled modules, compared with the sources.

Runs with compiled modules and runs with the sources alternate. Each run starts all processes again.
"""

from __future__ import annotations

import statistics
import sys
from functools import partial
from typing import TYPE_CHECKING

from bench.experiments.speed.gateway import played
from bench.framework.measurement import percentile, speed_experiment, timed_result
from bench.rigs.gateway import Load, run
from tests.broker_fixture import MosquittoBroker
from tests.compiled_variant import is_current

if TYPE_CHECKING:
    from bench.framework.experiment import Result
    from bench.rigs.gateway import Figures

TARGETS_PERCENT: dict[float, float | None] = {100.0: None, 200.0: 8.0, 400.0: 12.0}
"""Target of the CPU share with compiled modules, by rate of the sensors."""
ROUNDS, SECONDS = 3, 10.0
QUICK_ROUNDS, QUICK_S = 1, 3.0
VARIANTS = {"sources": False, "compiled": True}


def rows(quick: bool) -> list[Result]:
    """Return CPU share, latency, memory and unaccounted samples of both variants.

    The CPU share is the median of the rounds, the memory the maximum. Latencies and counts are of
    all rounds together.
    """
    if (reason := MosquittoBroker.missing()) is not None or (reason := _missing_modules()):
        print(f"not run: {reason}", file=sys.stderr)
        return []
    rounds, seconds = (QUICK_ROUNDS, QUICK_S) if quick else (ROUNDS, SECONDS)
    found = []
    for rate_hz, target in TARGETS_PERCENT.items():
        if quick and rate_hz != 200.0:
            continue
        runs: dict[str, list[Figures]] = {name: [] for name in VARIANTS}
        for _ in range(rounds):
            for name, compiled in VARIANTS.items():
                play = partial(run, load=Load(rate_hz), seconds=seconds, compiled=compiled)
                figures = played("mosquitto", play)
                assert figures is not None
                runs[name].append(figures)
        for name, each in runs.items():
            found += _rows_of(
                f"4 × {rate_hz:g} Hz, {name}", each, target if name == "compiled" else None
            )
    return found


def _missing_modules() -> str:
    return (
        ""
        if is_current()
        else "build/compiled does not contain the current sources: run `make compiled`"
    )


def _rows_of(title: str, runs: list[Figures], target: float | None) -> list[Result]:
    shares = [100 * one.cpu_s / one.seconds for one in runs]
    latencies_ms = [one for each in runs for one in each.latencies_ms]
    frames, p99_ms = len(latencies_ms), percentile(latencies_ms, 0.99)
    ratios = [one.cpu_s / max(1, len(one.latencies_ms)) / one.loop_s for one in runs]
    frame_us = 1e6 * sum(one.cpu_s for one in runs) / frames
    note = f"{frame_us:.0f} µs per frame; {min(shares):.1f} to {max(shares):.1f}"
    unaccounted, dropped = sum(one.unaccounted for one in runs), sum(one.dropped for one in runs)
    return [
        timed_result(
            f"{title}: CPU of the daemon", round(statistics.median(shares), 1), "% of a core",
            target, ratio=round(statistics.median(ratios), 2), note=note,
        ),
        timed_result(f"{title}: latency, p99", round(p99_ms, 2), "ms", note=f"{frames} frames"),
        timed_result(
            f"{title}: memory of the daemon", round(max(one.rss_mb for one in runs), 1), "MB", 70
        ),
        timed_result(f"{title}: samples unaccounted for", unaccounted, "", 0, 0),
        timed_result(f"{title}: samples dropped", dropped, "", 0),
    ]  # fmt: skip


EXPERIMENTS = (
    speed_experiment(
        "gateway-variants",
        "Processes: compiled modules and sources, optical frames at 100 Hz, mosquitto",
        rows,
        in_short_run=False,
    ),
)
