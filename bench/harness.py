"""What every speed bench shares: paired runs, medians, a table with goals, an exit code.

Machines differ and are noisy, so every time is also given as a ratio to a fixed loop that ran
in the same breath, and a floor is a multiple of its goal that only a real regression passes.
"""

from __future__ import annotations

import statistics
import sys
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import orjson
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path


@dataclass(frozen=True)
class Row:
    """One measured figure."""

    name: str
    figure: float
    unit: str
    goal: float | None = None
    """What the project wants, the same unit; smaller is better."""
    floor: float | None = None
    """What fails the bench."""
    ratio: float | None = None
    """Figure over the fixed loop of the same run, where the figure is a time."""
    note: str = ""

    @property
    def missed(self) -> bool:
        return self.floor is not None and not self.figure <= self.floor


def fixed_loop() -> int:
    """Some integer arithmetic and attribute-free Python: what a time is compared with."""
    total = 0
    for k in range(2000):
        total = (total * 31 + k) & 0xFFFF
    return total


def seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def per_item(
    name: str,
    prepare: Callable[[], Callable[[], object]],
    *,
    items: int,
    goal_us: float,
    slack: float = 4.0,
    repeats: int = 15,
    note: str = "",
) -> Row:
    """Median time per item over paired repeats; `prepare` makes a fresh piece of work each time."""
    prepare()()  # warm up
    times, ratios = [], []
    for _ in range(repeats):
        work = prepare()
        loop = seconds(fixed_loop)
        took = seconds(work) / items
        times.append(took)
        ratios.append(took / loop)
    return Row(
        name,
        round(statistics.median(times) * 1e6, 2),
        "µs",
        goal_us,
        goal_us * slack,
        round(statistics.median(ratios), 4),
        note,
    )


def report(title: str, rows: Sequence[Row], json: Path | None = None) -> int:
    """Print the table, write the machine-readable results; return the exit code."""
    table = Table(title=title, title_justify="left")
    for column in ("what", "measured", "goal", "floor", "× fixed loop", "note"):
        table.add_column(column, justify="right" if column not in ("what", "note") else "left")
    for row in rows:
        table.add_row(
            row.name,
            f"[red]{row.figure:g} {row.unit}[/]" if row.missed else f"{row.figure:g} {row.unit}",
            "" if row.goal is None else f"{row.goal:g}",
            "" if row.floor is None else f"{row.floor:g}",
            "" if row.ratio is None else f"{row.ratio:g}",
            row.note,
        )
    Console(width=140 if not sys.stdout.isatty() else None).print(table)
    if json is not None:
        json.write_bytes(orjson.dumps([asdict(row) for row in rows], option=orjson.OPT_INDENT_2))
    missed = [row.name for row in rows if row.missed]
    for name in missed:
        print(f"floor missed: {name}")
    return 1 if missed else 0
