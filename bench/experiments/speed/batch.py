"""Batch of recordings: time with two processes and with one, and memory over many recordings."""

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
from bench.framework.measurement import speed_experiment, timed_result
from bench.rigs.gateway import rss_mb
from jointfit_daemon.tools.batch.executors import run_in_pool
from jointfit_daemon.tools.batch.find_recordings import find_recordings
from tests.reprocessing import recorded_run

if TYPE_CHECKING:
    from collections.abc import Sequence

SAMPLES = 5000
"""Number of samples of each sensor in a recording for the speed, 50 s. The processing is long
compared with the start of a process."""
COUNT, ROUNDS = 16, 2
"""Number of recordings per round, and number of alternating rounds."""
MANY, WARM = 1000, 50
"""Number of short recordings for the memory, and number of recordings after which all libraries are
loaded."""


def batch_results(quick: bool) -> list[Result]:
    """Measure batches with one and two processes in turn, then run a long batch."""
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
    return [
        Result(
            "two processes against one", round(statistics.median(speedups), 2), minimum=1.8,
            unit="×", note=note,
        ),
        timed_result("one recording, one process", round(min(seconds[1]) / count, 2), "s"),
        timed_result("memory of a process", round(after_mb, 1), "MB", 200, 400),
        timed_result(
            f"growth of memory from recording {warm} to {many}", round(after_mb - before_mb, 1),
            "MB", 10, 30,
        ),
    ]  # fmt: skip


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
)
