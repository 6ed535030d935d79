"""Cost of the web dashboard: for the daemon, for its server, and in the browser."""

from __future__ import annotations

import asyncio
import shutil
import statistics
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from bench.framework.experiment import Result
from bench.framework.measurement import percentile, speed_experiment, timed_result
from tests.broker_fixture import MosquittoBroker

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine
    from typing import Any, TypeVar

    Found = TypeVar("Found")

ROUNDS, ROUND_S = 8, 5.0
WINDOWS, DRAWN_S = 7, 10.0


def _at_mosquitto(play: Callable[[Path, int], Coroutine[Any, Any, Found]]) -> Found | None:
    if (reason := MosquittoBroker.missing()) is not None:
        print(f"not run: {reason}", file=sys.stderr)
        return None
    with tempfile.TemporaryDirectory(prefix="jointfit-bench-") as temporary:
        broker = MosquittoBroker(Path(temporary))
        broker.start()
        try:
            return asyncio.run(play(Path(temporary), broker.port))
        finally:
            broker.stop()


def viewer_results(quick: bool) -> list[Result]:
    """Compare rounds without viewers, with one viewer, and with ten viewers."""
    from bench.rigs.dashboard import measure_viewers  # noqa: PLC0415 - needs the browser's package

    rounds, seconds = (2, 2.0) if quick else (ROUNDS, ROUND_S)
    found = _at_mosquitto(lambda folder, port: measure_viewers(folder, port, rounds, seconds))
    if found is None:
        return []
    pairs = zip(found.daemon_pct[0], found.daemon_pct[10], strict=True)
    differences = [ten - none for none, ten in pairs]
    mean = statistics.fmean(differences)
    error = statistics.stdev(differences) / len(differences) ** 0.5
    without = statistics.fmean(found.daemon_pct[0])
    note = (
        f"ten viewers minus none: mean {mean:.1f}, standard error {error:.1f}, {rounds}"
        f" pairs of rounds of {seconds:g} s; {without:.1f} without viewers"
    )
    # Other processes change the CPU time of a round more than any number of viewers.
    certain = round(max(0.0, mean - 2.0 * error), 2)
    name = "daemon: extra CPU with ten viewers, mean minus two standard errors, at least 0"
    results = [timed_result(name, certain, "% of a core", 0.5, 3.0, note=note)]
    for count, words, target in (
        (0, "no viewer", None),
        (1, "one viewer", 3.0),
        (10, "ten viewers", None),
    ):
        share = round(statistics.median(found.server_pct[count]), 2)
        note = "" if count == 0 else f"{found.kilobytes_s:.0f} kB/s to each"
        threshold = None if target is None else 4 * target
        name = f"dashboard server, {words}"
        results += [
            timed_result(f"{name}: CPU", share, "% of a core", target, threshold, note=note),
            timed_result(f"{name}: memory", round(found.server_mb[count], 1), "MB", 40, 60),
        ]
    return results


def page_results(quick: bool) -> list[Result]:
    """Measure the page in Chromium."""
    from bench.rigs.dashboard import measure_page  # noqa: PLC0415 - needs the browser's package

    if shutil.which("chromium") is None:
        print("not run: chromium is not installed (Debian: apt install chromium)", file=sys.stderr)
        return []
    windows, seconds = (2, 3.0) if quick else (WINDOWS, DRAWN_S)
    found = _at_mosquitto(lambda _, port: measure_page(port, windows, seconds))
    if found is None:
        return []
    slowest, drawn = max(found.paint_ms), len(found.limb_ms)
    limb = percentile(found.limb_ms, 0.5), percentile(found.limb_ms, 0.99)
    return [
        timed_result("page: transferred", round(found.transferred_kb, 1), "kB", 300, 300),
        timed_result(
            "page: first contentful paint, median", round(statistics.median(found.paint_ms)), "ms",
            1000, 4000, note=f"{windows} new windows, slowest {slowest:.0f} ms",
        ),
        timed_result(
            "limb: main-thread time of a frame, median", round(limb[0], 2), "ms", 5, 20,
            note=f"{drawn} frames",
        ),
        timed_result("limb: main-thread time of a frame, p99", round(limb[1], 2), "ms"),
        Result("limb: frames a second", round(drawn / found.seconds, 1), minimum=15, unit="Hz"),
        timed_result(
            "curve: main-thread time of an update, median",
            round(percentile(found.curve_ms, 0.5), 2), "ms", 5, 20,
        ),
    ]  # fmt: skip


_BROWSER = ("playwright", "axe_playwright_python")

EXPERIMENTS = (
    replace(
        speed_experiment(
            "dashboard-viewers",
            "Processes: 4 × 100 Hz, viewers of the dashboard, mosquitto",
            viewer_results,
        ),
        packages=_BROWSER,
    ),
    replace(
        speed_experiment("dashboard-page", "The dashboard's page in Chromium", page_results),
        packages=_BROWSER,
    ),
)
