"""One table of figures beside their goals: what every accuracy bench prints.

Rows come from a folder ``bench/NAME_rows``; figure and goal stand side by side, and a missed goal
is exit code 1. What cannot run here is listed with the reason and fails nothing.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.framework.experiment import DATA, find_experiments

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from bench.framework.experiment import Experiment, Figure

HEAD = ("row", "experiment", "figure", "measured", "goal", "")


def measure(experiments: Sequence[Experiment]) -> list[dict[str, Any]]:
    """Return one dict a row: figures, or why there are none."""
    results: list[dict[str, Any]] = []
    for experiment in experiments:
        result: dict[str, Any] = {"id": experiment.id, "title": experiment.title, "figures": []}
        result["skipped"] = experiment.missing()
        if result["skipped"] is None:
            began = time.perf_counter()
            result["figures"] = experiment.run(DATA)
            result["seconds"] = round(time.perf_counter() - began, 3)
        results.append(result)
    return results


def lines(results: Sequence[dict[str, Any]]) -> list[tuple[str, ...]]:
    """Return the table, one line a figure."""
    table: list[tuple[str, ...]] = []
    for result in results:
        if result["skipped"] is not None:
            table.append((result["id"], result["title"], "", "", "", "not run"))
        for index, figure in enumerate(result["figures"]):
            lead = (result["id"], result["title"]) if index == 0 else ("", "")
            verdict = "" if figure.kept else "MISSED"
            table.append((*lead, figure.name, number(figure), figure.goal_text, verdict))
    return table


def number(figure: Figure) -> str:
    """Return the measured value with its unit, short but not rounded away."""
    size = abs(figure.value)
    text = f"{figure.value:.3g}" if 0.0 < size < 0.01 else f"{figure.value:.3f}"
    return f"{text} {figure.unit}".rstrip()


def as_markdown(table: Sequence[tuple[str, ...]]) -> str:
    rows = [HEAD, ("---",) * len(HEAD), *table]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def as_text(table: Sequence[tuple[str, ...]]) -> str:
    widths = [max(len(row[i]) for row in [HEAD, *table]) for i in range(len(HEAD))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in [HEAD, *table]
    )


def as_json(results: Sequence[dict[str, Any]]) -> str:
    plain = [
        {
            **result,
            "figures": [
                {
                    "name": figure.name,
                    "value": float(figure.value),
                    "unit": figure.unit,
                    "goal": figure.goal_text,
                    "kept": bool(figure.kept),
                }
                for figure in result["figures"]
            ],
        }
        for result in results
    ]
    return json.dumps(plain, indent=1, ensure_ascii=False) + "\n"


def main(
    about: str, folder: str, extend: Callable[[argparse.ArgumentParser], None] | None = None
) -> tuple[int, argparse.Namespace]:
    """Measure the rows of ``bench/<folder>`` that the command line asks for, and print them.

    Returns the exit code and the options, `extend` having added what the bench has of its own.
    """
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("ids", nargs="*", metavar="ID", help="only these rows")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    parser.add_argument("--markdown", action="store_true", help="print the table for docs")
    if extend is not None:
        extend(parser)
    options = parser.parse_args()
    experiments = find_experiments(folder)
    unknown = set(options.ids) - {experiment.id for experiment in experiments}
    if unknown:
        parser.error(
            f"no row {', '.join(sorted(unknown))}; there are: "
            f"{', '.join(experiment.id for experiment in experiments)}"
        )
    results = measure([e for e in experiments if not options.ids or e.id in options.ids])
    print((as_markdown if options.markdown else as_text)(lines(results)))
    if options.json:
        options.json.write_text(as_json(results))
    return _verdict(results), options


def _verdict(results: Sequence[dict[str, Any]]) -> int:
    for result in results:
        if result["skipped"] is not None:
            print(f"{result['id']} not run: {result['skipped']}", file=sys.stderr)
    missed = [r["id"] for r in results if not all(figure.kept for figure in r["figures"])]
    if missed:
        print(f"goals missed: {', '.join(missed)}", file=sys.stderr)
    return 1 if missed else 0
