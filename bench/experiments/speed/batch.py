"""`jointfit batch`: time with one and two processes, memory, growth with the recordings."""

from __future__ import annotations

import multiprocessing
import shutil
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

from bench.framework.experiment import Result
from bench.framework.exponents import growth_exponent
from bench.framework.measurement import loop_s, speed_experiment, timed_result
from bench.rigs.gateway import rss_mb
from jointfit_daemon.tools.batch.executors import run_in_pool
from jointfit_daemon.tools.batch.find_recordings import find_recordings
from jointfit_daemon.tools.batch.summary import write_summary
from tests.reprocessing import recorded_run

if TYPE_CHECKING:
    from collections.abc import Sequence

SAMPLES = 5000
"""Number of samples of each sensor in a recording of the speed measurement: 50 s."""
COUNT, ROUNDS = 16, 2
"""Number of recordings per round, and number of alternating rounds."""
SIZES, QUICK_SIZES = (1, 3, 10, 30, 100, 300, 1000), (1, 2, 4, 8)
"""Numbers of short recordings in the growth measurement. The ratio of successive numbers is about
the same."""
MANY, WARM = 1000, 50
"""Number of short recordings in the memory measurement, and number of recordings after which all
libraries are loaded."""


def batch_results(quick: bool) -> list[Result]:
    """Measure batches with one and two processes in turn, then the memory of a long batch."""
    count, rounds, many, warm = (4, 1, 40, 10) if quick else (COUNT, ROUNDS, MANY, WARM)
    with tempfile.TemporaryDirectory(prefix="jointfit-bench-") as temporary:
        folder = Path(temporary)
        with patch.object(recorded_run, "END", SAMPLES):
            trials = _copies(folder / "long", count)
        seconds: dict[int, list[float]] = {1: [], 2: []}
        for number in range(rounds):
            for jobs, found in seconds.items():
                found.append(_seconds(trials, folder / f"out-{number}-{jobs}", jobs))
        speedups = [one / two for one, two in zip(seconds[1], seconds[2], strict=True)]

        before_mb, after_mb = _memory(_copies(folder / "short", many), folder / "many", warm)
    note = f"{count} recordings of {SAMPLES / 100:.0f} s: replay, export, report; {rounds} rounds"
    # With few recordings, the start of the two processes is a large part of the time.
    least = 1.2 if quick else 1.8
    return [
        Result(
            "two processes against one", round(statistics.median(speedups), 2), minimum=least,
            unit="×", note=note,
        ),
        timed_result("one recording, one process", round(min(seconds[1]) / count, 2), "s"),
        timed_result("memory of a process", round(after_mb, 1), "MB", 200, 400),
        timed_result(
            f"growth of memory from recording {warm} to {many}", round(after_mb - before_mb, 1),
            "MB", 10, 30,
        ),
    ]  # fmt: skip


def recording_growth_results(quick: bool) -> list[Result]:
    """Measure batches of increasing size in one process, from the search to the summary.

    The CPU time of each step is divided by the time of a fixed loop just before it, so the load of
    the machine cancels.
    """
    sizes = QUICK_SIZES if quick else SIZES
    costs = []
    with tempfile.TemporaryDirectory(prefix="jointfit-bench-") as temporary:
        folder = Path(temporary)
        _batch_loops(_copies(folder / "warm", 2), folder / "out-warm")
        for size in sizes:
            trials = _copies(folder / f"{size}", size)
            costs.append(_batch_loops(trials, folder / f"out-{size}"))
            shutil.rmtree(trials)
    found = growth_exponent(sizes, costs)
    note = f"± {found.half_width:.3f}, {sizes[0]} to {sizes[-1]}"
    threshold = 1.5 if quick else 1.2  # a short run has too few recordings for 1.2
    return [
        timed_result("recordings: exponent", round(found.value, 3), "", 1.05, threshold, note=note),
        *(
            timed_result(f"recordings: {size}", round(cost, 1), "× loop")
            for size, cost in zip(sizes, costs, strict=True)
        ),
    ]


def _batch_loops(trials: Path, out: Path) -> float:
    """Return the CPU time of a batch with reports in this process, in units of the fixed loop."""
    out.mkdir()
    loop, began = loop_s(), time.process_time()
    tasks = find_recordings(trials, out, ("report",), ())
    spent = (time.process_time() - began) / loop

    results = []
    running = run_in_pool(tasks, 1)
    for _ in tasks:
        loop, began = loop_s(), time.process_time()
        results.append(next(running))
        spent += (time.process_time() - began) / loop
    _check([result.status for result in results])

    loop, began = loop_s(), time.process_time()
    write_summary(results, out)
    return spent + (time.process_time() - began) / loop


def _copies(folder: Path, count: int) -> Path:
    """Record a run, and return a folder with copies of the recording."""
    recorded_run.record_run(folder / "recorded")
    (file,) = (folder / "recorded").iterdir()
    trials = folder / "trials"
    trials.mkdir()
    for number in range(count):
        shutil.copy(file, trials / f"trial-{number:04d}.mcap")
    return trials


def _seconds(trials: Path, out: Path, jobs: int) -> float:
    tasks = find_recordings(trials, out, ("replay", "export", "report"), ("csv",))
    began_s = time.monotonic()
    _check([result.status for result in run_in_pool(tasks, jobs)])
    return time.monotonic() - began_s


def _memory(trials: Path, out: Path, warm: int) -> tuple[float, float]:
    """Return the memory of the largest process after `warm` recordings and at the end, MB."""
    tasks = find_recordings(trials, out, ("report",), ())
    found = []
    for number, result in enumerate(run_in_pool(tasks, 2), start=1):
        _check([result.status])
        if number in {warm, len(tasks)}:
            children = multiprocessing.active_children()
            found.append(max((rss_mb(child.pid or 0) for child in children), default=0.0))
    return found[0], found[-1]


def _check(statuses: Sequence[str]) -> None:
    assert set(statuses) == {"done"}, statuses


EXPERIMENTS = (
    replace(
        speed_experiment(
            "batch-of-recordings", "`jointfit batch` of simulated runs", batch_results
        ),
        long=True,
    ),
    replace(
        speed_experiment(
            "growth-recordings",
            "Growth with the recordings of a batch",
            recording_growth_results,
        ),
        long=True,
    ),
)
