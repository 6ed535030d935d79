"""Machine instructions of a frame on x86-64 and arm64, and estimated CPU share of a Raspberry Pi.

QEMU's user emulation counts instructions; it does not measure time. The CPU time of another
processor is estimated from its clock rate and an assumed number of instructions per cycle. No
Raspberry Pi was measured. The whole daemon needs several times the CPU time of its core.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

from bench.experiments.speed.core import worn
from bench.framework.experiment import Experiment, Result
from bench.framework.material import THIS_MACHINE
from bench.framework.measurement import timed_result
from bench.rigs.core_frames import RATE_HZ

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).resolve().parents[3]
LARGEST_RATIO = 1.25
"""Threshold for the instructions on arm64, relative to x86-64."""


@dataclass(frozen=True)
class Processor:
    """Processor of a small computer."""

    name: str
    clock_hz: float
    per_cycle: float
    """Instructions per cycle while Python code is interpreted, assumed."""


PROCESSORS = (
    Processor("Raspberry Pi Zero 2 W (Cortex-A53, 1.0 GHz)", 1.0e9, 0.6),
    Processor("Raspberry Pi 4 (Cortex-A72, 1.5 GHz)", 1.5e9, 1.2),
    Processor("Raspberry Pi 5 (Cortex-A76, 2.4 GHz)", 2.4e9, 1.9),
)


def rows(_: Path) -> list[Result]:
    """Return the instructions of a frame, and estimated CPU shares."""
    with tempfile.TemporaryDirectory() as name:
        calibration = Path(name) / "calibration.json"
        calibration.write_text(json.dumps(worn().to_dict()), encoding="utf-8")
        done = subprocess.run(  # noqa: S603 - our own program
            [sys.executable, ".ci/machine_instructions.py", str(calibration)],
            cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    if done.returncode:
        print("not run: see above", file=sys.stderr)
        return []
    return list(_results(json.loads(done.stdout)))


def _results(found: dict[str, float]) -> Iterator[Result]:
    x86, arm = found["x86_64"], found["aarch64"]
    name = f"4 × {RATE_HZ:g} Hz, bytes to pose"
    yield timed_result(f"{name}: x86-64", round(x86 / 1e6, 3), "million instructions a frame")
    yield timed_result(f"{name}: arm64", round(arm / 1e6, 3), "million instructions a frame")
    yield Result(f"{name}: arm64 over x86-64", round(arm / x86, 3), LARGEST_RATIO, unit="")
    for processor in PROCESSORS:
        per_cycle = processor.per_cycle
        frame_s = arm / (processor.clock_hz * per_cycle)
        yield Result(
            f"estimate of the core, {processor.name}", round(100 * frame_s * RATE_HZ, 1), inf,
            unit="% of a core",
            note=f"{1e3 * frame_s:.2f} ms a frame, with {per_cycle:g} instructions per cycle",
        )  # fmt: skip


EXPERIMENTS = (
    Experiment(
        "machine-instructions",
        "Machine instructions of a frame on x86-64 and arm64",
        rows,
        THIS_MACHINE,
        long=True,
    ),
)
