"""The score of the stored mutants, for docs/reliability.md."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results.json"
Z_95 = 1.959964
"""Quantile of the normal distribution for intervals of 95 %."""


def interval(killed: int, total: int) -> tuple[float, float]:
    """Return the interval of Wilson with 95 % confidence for a share."""
    share, width = killed / total, Z_95**2 / total
    center = (share + width / 2) / (1 + width)
    half = Z_95 / (1 + width) * math.sqrt(share * (1 - share) / total + width / (4 * total))
    return center - half, center + half


def table_of(results: dict[str, Any]) -> str:
    """Return the score of each package and of all as a table.

    Equivalent mutants behave as the original, so no test can fail; they are not counted.
    """
    rows = [
        "| package | mutants | killed | survived | equivalent | score, % | interval, % |",
        "| --- | --: | --: | --: | --: | --: | --: |",
    ]
    mutants = results["mutants"]
    for package in [*sorted({one["package"] for one in mutants}), "all"]:
        counts = Counter(one["outcome"] for one in mutants if package in {one["package"], "all"})
        judged = counts["killed"] + counts["survived"]
        if judged:
            low, high = interval(counts["killed"], judged)
            rows.append(
                f"| {package} | {counts.total()} | {counts['killed']} | {counts['survived']} | "
                f"{counts['equivalent']} | {100 * counts['killed'] / judged:.0f} | "
                f"{100 * low:.0f} to {100 * high:.0f} |"
            )
    return "\n".join(rows)
