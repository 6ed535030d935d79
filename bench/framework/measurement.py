"""What every speed bench shares: paired runs, medians, a table with goals, results for programs.

Law: a figure is a median over repeats, and is also given as a ratio to a fixed loop of plain Python
that ran in the same breath, because machines differ and are noisy. The goal is what the project
wants; the floor is a multiple of it that only a real regression passes.
"""

from __future__ import annotations

import gc
import platform
import statistics
import time
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

HEAD = ("what", "measured", "goal", "floor", "× loop", "")
LIBRARIES = ("numpy", "scipy", "orjson", "aiomqtt", "python-can")


@dataclass(frozen=True, slots=True)
class Row:
    """One measured figure; smaller is better."""

    name: str
    figure: float
    unit: str
    goal: float | None = None
    """What the project wants, the same unit."""
    floor: float | None = None
    """What fails the bench when it is passed."""
    ratio: float | None = None
    """Figure over the fixed loop of the same run, where the figure is a time."""
    note: str = ""

    @property
    def missed(self) -> bool:
        return self.floor is not None and not self.figure <= self.floor

    @property
    def reached(self) -> bool:
        return self.goal is None or self.figure <= self.goal


@dataclass(frozen=True, slots=True)
class Bench:
    """Some rows that are measured together."""

    id: str
    title: str
    run: Callable[[bool], list[Row]]
    """Given whether it must be quick, measures."""


def fixed_loop() -> int:
    """Some integer arithmetic and attribute-free Python: what a time is compared with."""
    total = 0
    for k in range(2000):
        total = (total * 31 + k) & 0xFFFF
    return total


def cpu_s(work: Callable[[], object]) -> float:
    """Return the CPU time of this thread that `work` takes, s: what others do does not count."""
    began = time.thread_time()
    work()
    return time.thread_time() - began


def loop_s(repeats: int = 9) -> float:
    """Return the median CPU time of the fixed loop, s."""
    return statistics.median(cpu_s(fixed_loop) for _ in range(repeats))


def repeats(quick: bool) -> int:
    """Return how often a short piece of work is timed."""
    return 3 if quick else 25


def per_item(
    name: str,
    prepare: Callable[[], Callable[[], object]],
    *,
    items: int,
    goal_us: float | None,
    quick: bool,
    slack: float = 4.0,
    note: str = "",
) -> Row:
    """Median CPU time per item over paired repeats; `prepare` makes fresh work for each."""
    prepare()()  # warm up
    times, ratios = [], []
    for _ in range(repeats(quick)):
        work = prepare()
        gc.collect()  # what others left is not this work's
        loop = cpu_s(fixed_loop)
        took = cpu_s(work) / items
        times.append(took)
        ratios.append(took / loop)
    floor = None if goal_us is None else goal_us * slack
    figure = round(statistics.median(times) * 1e6, 2)
    return Row(name, figure, "µs", goal_us, floor, round(statistics.median(ratios), 4), note)


def percentile(values: Sequence[float], share: float) -> float:
    """Return the value that `share` of `values` do not exceed (nearest rank)."""
    ranked = sorted(values)
    return ranked[min(len(ranked) - 1, int(share * len(ranked)))]


def find_benches() -> list[Bench]:
    """Return all benches of ``bench/experiments/speed``, in order of module and place."""
    folder = Path(__file__).parents[1] / "experiments" / "speed"
    found: list[Bench] = []
    for module in sorted(iter_modules([str(folder)]), key=lambda info: info.name):
        found += import_module(f"bench.experiments.speed.{module.name}").BENCHES
    return found


# --- telling ----------------------------------------------------------------------------------


def machine() -> dict[str, object]:
    """Return what the figures hold for, as JSON values."""
    return {
        "processor": _processor(),
        "cores": _cores(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in LIBRARIES},
        "fixed_loop_us": round(loop_s() * 1e6, 1),
        "measured_utc": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _cpuinfo() -> list[str]:
    try:
        return Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []


def _processor() -> str:
    named = [line.partition(":")[2].strip() for line in _cpuinfo() if line.startswith("model name")]
    return named[0] if named else platform.processor() or "unknown"


def _cores() -> int:
    return sum(line.startswith("processor") for line in _cpuinfo())


def lines(rows: Sequence[Row]) -> list[tuple[str, ...]]:
    """Return the table, one line a row."""
    return [
        (
            row.name,
            f"{row.figure:g} {row.unit}".rstrip(),
            "" if row.goal is None else f"{row.goal:g}",
            "" if row.floor is None else f"{row.floor:g}",
            "" if row.ratio is None else f"{row.ratio:g}",
            " ".join(part for part in (_verdict(row), row.note) if part),
        )
        for row in rows
    ]


def _verdict(row: Row) -> str:
    if row.missed:
        return "FLOOR MISSED"
    return "" if row.reached else "goal missed"


def as_markdown(rows: Sequence[Row]) -> str:
    table = [HEAD, ("---", "--:", "--:", "--:", "--:", "---"), *lines(rows)]
    return "\n".join("| " + " | ".join(row) + " |" for row in table)


def as_text(rows: Sequence[Row]) -> str:
    table = [HEAD, *lines(rows)]
    widths = [max(len(row[i]) for row in table) for i in range(len(HEAD))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if 0 < i < len(HEAD) - 1 else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in table
    )


def as_json(benches: Sequence[tuple[Bench, list[Row]]]) -> dict[str, Any]:
    return {
        "machine": machine(),
        "benches": [
            {
                "id": bench.id,
                "title": bench.title,
                "rows": [
                    {**asdict(row), "missed": row.missed, "reached": row.reached} for row in rows
                ],
            }
            for bench, rows in benches
        ],
    }
