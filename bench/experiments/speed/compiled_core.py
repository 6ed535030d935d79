"""CPU time of a frame in each part of the daemon: compiled modules compared with their sources.

Two processes run on the same compiled tree. One of them has ``JOINTFIT_PURE=1`` and therefore uses
the Python sources. The processes measure each part in turn, so the load of a shared machine affects
both equally.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from bench.experiments.speed.core import worn
from bench.framework.measurement import speed_experiment, timed_result

if TYPE_CHECKING:
    from bench.framework.experiment import Result

ROOT = Path(__file__).resolve().parents[3]
TREE = ROOT / "build" / "compiled"
ROUNDS = 5
SLOWER = 1.1
"""Threshold for the ratio of compiled to pure time. Compilation must not slow a part down."""
MEASUREMENTS = {
    "xbus: bytes to SI sample": ("xbus", None),
    "slcan: codec, one CAN frame": ("can", None),
    "xcdi: 3 CAN frames to SI sample": ("can", None),
    "natnet: codec, one frame": ("natnet", 25.0),
    "natnet: bytes to MocapFrame": ("natnet", None),
    "clock: one sample": ("clock", None),
    "aligner: one sample": ("aligner", None),
    "fusion: one frame of 4 sensors": ("fusion", None),
    "output: pose as JSON": ("fusion", 10.0),
    "core: 4 × 100 Hz, bytes to limb state, median": ("core", 80.0),
    "core: 4 × 400 Hz, bytes to limb state, median": ("core", 200.0),
}
"""Part that contains the measurement, and target of the compiled time, µs, by measurement."""
Process: TypeAlias = "subprocess.Popen[str]"


def compiled_rows(quick: bool) -> list[Result]:
    """Return the CPU times of both variants; nothing if no current compiled modules exist."""
    if not _is_current():
        print("compiled-core: run `make compiled` first", file=sys.stderr)
        return []
    with ExitStack() as running:
        both = {name: running.enter_context(_process(name)) for name in ("pure", "compiled")}
        calibration = json.dumps(worn().to_dict())
        for process in both.values():
            _write(process, calibration)
        found = [_round(both) for _ in range(1 if quick else ROUNDS)]

    rows = []
    for name, (_, target) in MEASUREMENTS.items():
        pure, compiled = (
            statistics.median(times[variant][name] for times in found) for variant in both
        )
        ratios = [times["compiled"][name] / times["pure"][name] for times in found]
        rows += [
            timed_result(f"{name}: sources", round(pure, 2), "µs"),
            timed_result(f"{name}: compiled", round(compiled, 2), "µs", target),
            timed_result(
                f"{name}: ratio of compiled to sources",
                round(statistics.median(ratios), 3), "", None, SLOWER,
            ),
        ]  # fmt: skip
    return rows


def _is_current() -> bool:
    words = [sys.executable, str(ROOT / "packaging" / "compiled.py"), "--check"]
    return subprocess.run(words, check=False).returncode == 0  # noqa: S603 - our own program


def _process(variant: str) -> Process:
    """Start a process that uses one variant of the compiled tree."""
    process = subprocess.Popen(
        # -P prevents Python from importing the checkout in the current folder.
        [sys.executable, "-P", "-m", "bench.rigs.variant_process"],
        env=os.environ
        | {
            "PYTHONPATH": os.pathsep.join((str(TREE), str(ROOT))),
            "JOINTFIT_PURE": str(int(variant == "pure")),
        },
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    found = _answer(process)
    if found != variant:
        raise RuntimeError(f"{TREE}: a process runs {found!r} modules, not {variant!r} ones")
    return process


def _write(process: Process, line: str) -> None:
    assert process.stdin is not None
    print(line, file=process.stdin, flush=True)


def _answer(process: Process) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise RuntimeError("a measuring process ended; its error is above")
    return line.strip()


def _round(both: dict[str, Process]) -> dict[str, dict[str, float]]:
    """Return the times of each variant, µs, by measurement; the variants take turns."""
    times: dict[str, dict[str, float]] = {variant: {} for variant in both}
    for part in dict.fromkeys(part for part, _ in MEASUREMENTS.values()):
        for variant, process in both.items():
            _write(process, part)
            times[variant] |= json.loads(_answer(process))
    return times


EXPERIMENTS = (
    speed_experiment("compiled-core", "Compiled modules and their sources", compiled_rows),
)
