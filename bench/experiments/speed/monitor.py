"""Cost of the terminal monitor: bytes and updates per second to the terminal, and CPU time.

The monitor runs in a pseudo-terminal together with simulated devices and the daemon. The terminal
sizes and update rates are measured in turn, so the load of the machine affects all of them equally.
"""

from __future__ import annotations

import asyncio
import os
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from bench.framework.measurement import speed_experiment, timed_result
from bench.rigs.gateway import Load, running_gateway
from jointfit_daemon.tools.embedded_broker import HOST
from tests.broker_fixture import MosquittoBroker
from tests.tools.monitor.terminal import terminal_program

if TYPE_CHECKING:
    from bench.framework.experiment import Result

CASES = (((80, 24), 5.0), ((80, 24), 10.0), ((40, 20), 5.0), ((120, 40), 5.0))
"""Measured cases: columns and rows of the terminal, and value of ``--rate``."""
ROUNDS, SECONDS, QUICK_S = 3, 6.0, 2.0
WARM_UP_S = 12.0
"""Time until the plotted curve has its full length, s. It is not part of the measurement."""
START_S = 40.0
PAUSE_S = 0.025
"""Longest pause within an update, s. A large update arrives in several parts.
"""
LIMIT_HZ = 10.0
"""Maximum number of updates per second."""


@dataclass
class Samples:
    """Measurements of one case, one per round."""

    bytes_s: list[float] = field(default_factory=list)
    updates_s: list[float] = field(default_factory=list)
    cpu_pct: list[float] = field(default_factory=list)


async def _measure(base: str, port: int, seconds: float, rounds: int) -> list[Samples]:
    found = [Samples() for _ in CASES]
    for _ in range(rounds):
        for (size, rate), samples in zip(CASES, found, strict=True):
            await _one(samples, (base, port), size, rate, seconds)
    return found


async def _one(
    samples: Samples, target: tuple[str, int], size: tuple[int, int], rate: float, seconds: float
) -> None:
    """Add one measurement of the monitor, with the base topic and broker port in `target`."""
    base, port = target
    command = [
        sys.executable, "-m", "jointfit_daemon.tools.__main__", "monitor", "--base", base,
        "--broker", f"mqtt://{HOST}:{port}", "--rate", str(rate),
    ]  # fmt: skip
    environment = {**os.environ, "TERM": "xterm-256color", "LC_ALL": "C.UTF-8"}
    async with terminal_program(command, size, environment) as program:
        await program.shows("Knee flexion", within_s=START_S)
        await asyncio.sleep(WARM_UP_S if seconds > QUICK_S else QUICK_S)
        program.arrivals_s.clear()
        began, received, cpu_s = time.monotonic(), program.screen.received, program.cpu_s()
        await asyncio.sleep(seconds)
        took = time.monotonic() - began
        samples.bytes_s.append((program.screen.received - received) / took)
        samples.cpu_pct.append(100.0 * (program.cpu_s() - cpu_s) / took)
        samples.updates_s.append(updates(program.arrivals_s) / took)


def updates(arrivals_s: list[float]) -> int:
    """Return the number of updates, from the arrival times of the output."""
    starts = arrivals_s[:1] + [
        later for before, later in pairwise(arrivals_s) if later - before > PAUSE_S
    ]
    return len(starts)


def monitor_rows(quick: bool) -> list[Result]:
    if (reason := MosquittoBroker.missing()) is not None:
        print(f"not run: {reason}", file=sys.stderr)
        return []
    with tempfile.TemporaryDirectory(prefix="jointfit-bench-") as temporary:
        folder = Path(temporary)
        broker = MosquittoBroker(folder)
        broker.start()
        try:
            found = asyncio.run(_played(folder, broker.port, quick))
        finally:
            broker.stop()
    rows = []
    for ((columns, lines), rate), samples in zip(CASES, found, strict=True):
        name = f"monitor: {columns} × {lines}, --rate {rate:g}"
        kilobytes = statistics.median(samples.bytes_s) / 1000
        share = statistics.median(samples.cpu_pct)
        rows += [
            timed_result(f"{name}: to the terminal", round(kilobytes, 1), "kB/s", None, 60.0),
            timed_result(f"{name}: CPU", round(share, 1), "% of a core", 10.0, 50.0),
            timed_result(
                f"{name}: updates", round(max(samples.updates_s), 1), "a second", rate,
                LIMIT_HZ + 1.0 / SECONDS,
            ),
        ]  # fmt: skip
    return rows


async def _played(folder: Path, port: int, quick: bool) -> list[Samples]:
    async with running_gateway(folder, port, Load(100.0)) as gateway:
        seconds, rounds = (QUICK_S, 1) if quick else (SECONDS, ROUNDS)
        return await _measure(gateway.base, port, seconds, rounds)


EXPERIMENTS = (
    speed_experiment(
        "terminal-monitor-cost",
        "Terminal monitor: bytes, updates and CPU time a second",
        monitor_rows,
    ),
)
