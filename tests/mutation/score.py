"""The score of the stored mutants, for docs/reliability.md."""

from __future__ import annotations

import math
import sys
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


def stored_outcomes(
    drawn: list[dict[str, Any]], stored: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return the stored outcomes of an interrupted run that drew the same sample.

    Raises
    ------
    SystemExit
        The stored sample is another one, or the code changed.
    """
    keys = ("package", "file", "line")
    if [[one[key] for key in keys] for one in stored] != [
        [one[key] for key in keys] for one in drawn
    ]:
        sys.exit("--resume: the stored sample is another one, or the code changed: omit it")
    return stored


def text_of(results: dict[str, Any]) -> str:
    """Return the score of the stored sample for docs/reliability.md."""
    tested = [one for one in results["mutants"] if one["outcome"]]
    text = (
        f"The stored results contain {len(tested)} of the {results['drawn']} mutants with seed"
        f" {results['seed']}."
    )
    if len(tested) < results["drawn"]:
        text += (
            " The run was stopped before it tested the others, so packages that are not in the"
            " table have no score yet."
        )
    return f"{text}\n\n{table_of(tested)}"


def table_of(mutants: list[dict[str, Any]]) -> str:
    """Return the score of each package and of all, as drawn and after the review, as a table.

    The score as drawn is the share of killed mutants in the sample. Equivalent mutants behave as
    the original, so no test can fail. The score after the review excludes equivalent mutants and
    removed code.
    """
    rows = [
        "| package | mutants | killed | score, % | interval, % | killed later | equivalent |"
        " removed | survived | score after review, % |",
        "| --- | --: | --: | --: | --: | --: | --: | --: | --: | --: |",
    ]
    for package in [*sorted({one["package"] for one in mutants}), "all"]:
        counts = Counter(one["outcome"] for one in mutants if package in {one["package"], "all"})
        killed, total = counts["killed"], counts.total()
        low, high = interval(killed, total)
        judged = total - counts["equivalent"] - counts["removed"]
        reviewed = (killed + counts["killed later"]) / judged if judged else 1.0
        rows.append(
            f"| {package} | {total} | {killed} | {100 * killed / total:.0f} |"
            f" {100 * low:.0f} to {100 * high:.0f} | {counts['killed later']} |"
            f" {counts['equivalent']} | {counts['removed']} | {counts['survived']} |"
            f" {100 * reviewed:.0f} |"
        )
    return "\n".join(rows)
