"""CPU time of `jointfit replay` for verification and replay, compared with reading the file."""

from __future__ import annotations

import gc
import statistics
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from bench.framework.measurement import cpu_s, loop_s, speed_experiment, timed_result
from bench.rigs.recorded_leg import KINDS, record_leg
from jointfit_daemon.outputs.recording import open_recording, read_events
from jointfit_daemon.reprocessing import process_events, verify_recording

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.framework.experiment import Result
    from jointfit_daemon.reprocessing import Verification

SECONDS, ROUNDS = 90.0, 3
"""Recorded time after the calibration, s, and number of alternating rounds."""
GOAL_MS = 20.0
"""Target of the CPU time per second of recording, ms: processing at 50 times real time."""


def replay_results(_quick: bool) -> list[Result]:
    """Record the leg in real time, then read, replay and verify each recording in turn."""
    with tempfile.TemporaryDirectory(prefix="jointfit-bench-") as temporary:
        recordings = record_leg(Path(temporary), SECONDS)
        return [
            result
            for kind, path in recordings.items()
            for result in measure(KINDS[kind][0], path, ROUNDS)
        ]


def measure(name: str, path: Path, rounds: int) -> list[Result]:
    """Return the CPU times to read, replay and verify a recording."""
    verified = _verify(path)  # this call also loads all libraries
    work: dict[str, tuple[Callable[[], object], float | None]] = {
        "reading": (partial(_read, path), None),
        "replay": (partial(_replay, path), GOAL_MS),
        "verification": (partial(_verify, path), GOAL_MS),
    }
    found: dict[str, list[float]] = {part: [] for part in work}
    loops = []
    for _ in range(rounds):
        for part, (run, _goal) in work.items():
            gc.collect()
            loops.append(loop_s())
            found[part].append(cpu_s(run))

    results, loop = [], statistics.median(loops)
    for part, (_run, goal_ms) in work.items():
        took = statistics.median(found[part]) / verified.seconds
        note = f"{1.0 / took:.0f} × real time, {verified.seconds:.0f} s"
        limit = None if goal_ms is None else 10.0 * goal_ms
        results.append(
            timed_result(
                f"{name}: {part}", round(1e3 * took, 2), "ms/s", goal_ms, limit,
                ratio=round(took / loop, 1), note=note,
            )
        )  # fmt: skip
    return results


def _read(path: Path) -> int:
    return sum(1 for _ in open_recording(path).messages())


def _replay(path: Path) -> int:
    return sum(len(outputs) for _event, outputs in process_events(read_events(path)))


def _verify(path: Path) -> Verification:
    found = verify_recording(path)
    assert found.passed, found.lines()
    return found


EXPERIMENTS = (
    replace(
        speed_experiment(
            "replay-speed", "`jointfit replay` of recorded simulated legs", replay_results
        ),
        long=True,
        quick_run=None,
    ),
)
