"""Cost of a recording at 4 × 400 Hz: share of a processor core, memory, and size of the file.

A process with recording and a process without recording handle the same events, in turns. The CPU
time and the memory of a recording are the differences between the two processes.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.framework.measurement import speed_experiment, timed_result

if TYPE_CHECKING:
    from bench.framework.experiment import Result

ROOT = Path(__file__).resolve().parents[3]
ROUNDS, SECONDS, QUICK_S = 3, 20.0, 10.0
HOUR_S = 3600.0
MOST_SHARE_PCT, MOST_MEMORY_MB = 3.0, 40.0
"""Targets of the additional share of a core, percent, and of the additional memory, MB."""


def _cost(folder: Path, seconds: float, *options: str) -> dict[str, Any]:
    """Return the cost of one process, and the size of its recording, if any."""
    folder.mkdir()
    command = [
        sys.executable, "-m", "bench.rigs.recording_process", str(folder),
        "--seconds", str(seconds), *options,
    ]  # fmt: skip
    ran = subprocess.run(  # noqa: S603 - our own module
        command, cwd=ROOT, capture_output=True, text=True, check=True
    )
    cost: dict[str, Any] = json.loads(ran.stdout.splitlines()[-1])
    return cost | {"file_bytes": sum(path.stat().st_size for path in folder.iterdir())}


def recording_rows(quick: bool) -> list[Result]:
    seconds, rounds = (QUICK_S, 1) if quick else (SECONDS, ROUNDS)
    shares, memory_mb, ratios, sizes = [], [], [], []
    with tempfile.TemporaryDirectory(prefix="jointfit-bench-") as temporary:
        for number in range(rounds):
            recorded = _cost(Path(temporary) / f"{number}a", seconds)
            without = _cost(Path(temporary) / f"{number}b", seconds, "--without-recorder")
            shares.append(100.0 * (recorded["cpu_s"] - without["cpu_s"]) / recorded["elapsed_s"])
            memory_mb.append((recorded["memory_kib"] - without["memory_kib"]) * 1024e-6)
            ratios.append(recorded["file_bytes"] / recorded["raw_bytes"])
            sizes.append(recorded["file_bytes"] / recorded["elapsed_s"] * HOUR_S / 1e6)

    name = "recording: 4 × 400 Hz, states at 100 Hz"
    share, memory = statistics.median(shares), statistics.median(memory_mb)
    size, ratio = statistics.median(sizes), statistics.median(ratios)
    return [
        timed_result(f"{name}: CPU", round(share, 2), "% of a core", MOST_SHARE_PCT, 6.0),
        timed_result(f"{name}: memory", round(memory, 1), "MB", MOST_MEMORY_MB, MOST_MEMORY_MB),
        timed_result(f"{name}: file", round(size), "MB/h", None, 1000.0),
        timed_result(f"{name}: file over raw bytes", round(ratio, 2), "", None, 1.5),
    ]


EXPERIMENTS = (
    speed_experiment(
        "recording-cost",
        "Recording: CPU time, memory and size of the file",
        recording_rows,
    ),
)
