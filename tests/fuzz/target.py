"""Fuzz targets, and the limits that every case must meet.

A target is an interface of the program that receives data from outside. A case is one input to a
target. It may raise only the exceptions that are documented for the target. Its processor time per
byte and its additional memory are limited.
"""

from __future__ import annotations

import contextlib
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

LEAST_S = 0.15
"""Processor time that a case of any size may take, s. Poses may pause for 0.2 s."""
PER_BYTE_S = 100e-6
"""Additional processor time per byte, s. Measuring coverage slows the code down several times."""
MOST_GROWTH = 20_000_000
"""Largest increase of the resident memory in one case, bytes."""
REPEATS = 3
"""Number of repetitions of a case that exceeded a limit. The smallest value counts."""


class UnaccountedError(AssertionError):
    """Bytes were neither used nor counted as discarded."""


@dataclass(frozen=True, slots=True)
class Target:
    """One interface that is fuzzed.

    Attributes
    ----------
    name : str
        Name in the table, and of the folders of corpus and reproducers.
    run : callable
        Function that processes one input.
    seeds : callable
        Function that returns valid inputs.
    refusals : tuple of type
        Exceptions that are documented for bad input.
    share : float
        Share of the cases of a run, relative to the other targets.
    longest : int
        Largest generated input, bytes; if a seed is larger, its size is the limit. Short inputs
        reach the same code in less time. One test uses longer inputs.
    """

    name: str
    run: Callable[[bytes], None]
    seeds: Callable[[], list[bytes]]
    refusals: tuple[type[Exception], ...] = ()
    share: float = 1.0
    longest: int = 512


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one case."""

    seconds: float
    growth: int
    finding: str
    """Reason of a failure, whose first line identifies it; empty without a failure."""


def run_case(target: Target, data: bytes) -> Outcome:
    """Run one case and return its result."""
    seconds, growth, finding = measure_case(target, data)
    allowed_s = LEAST_S + PER_BYTE_S * len(data)
    if not finding and seconds > allowed_s:
        # The first run of a case may contain an import or a garbage collection.
        seconds = min(measure_case(target, data)[0] for _ in range(REPEATS))
        if seconds > allowed_s:
            finding = f"slow: {seconds:.2f} s for {len(data)} bytes, allowed {allowed_s:.2f} s"
    if not finding and growth > MOST_GROWTH:
        growth = min(measure_case(target, data)[1] for _ in range(REPEATS))  # without imports
    if not finding and growth > MOST_GROWTH:
        finding = f"memory: grew by {growth / 1e6:.0f} MB for {len(data)} bytes"
    return Outcome(seconds, growth, finding)


def measure_case(target: Target, data: bytes) -> tuple[float, int, str]:
    """Return processor time in seconds, added memory in bytes, and the finding of one run."""
    _forget_largest()
    before, began, finding = _largest_bytes(), time.process_time(), ""
    try:
        target.run(data)
    except target.refusals:
        pass
    except Exception as error:  # noqa: BLE001 - all other exceptions are findings
        finding = _described(error)
    return time.process_time() - began, _largest_bytes() - before, finding


def _forget_largest() -> None:
    """Restart the record of the largest resident memory, which earlier tests may have raised."""
    with contextlib.suppress(OSError):  # kernels without page monitoring
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _largest_bytes() -> int:
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])


def _described(error: Exception) -> str:
    """Return a line with exception and place, which identifies a fault, and then the traceback."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f"{frames[-1].filename.rpartition('/')[2]}:{frames[-1].name}" if frames else "?"
    ours = [frame for frame in frames if "/jointfit_" in frame.filename]
    if ours:
        place = f"{ours[-1].filename.rpartition('/')[2]}:{ours[-1].lineno}"
    return f"{type(error).__name__} at {place}\n" + "".join(traceback.format_exception(error))
