"""Conversion of results to a text table and to Markdown."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.framework.experiment import Experiment, Result

HEAD = ("experiment", "result", "value", "threshold", "target", "× loop", "")


def value_text(value: float, unit: str = "") -> str:
    """Return a value with its unit, with three decimals, or three digits if it is small."""
    text = f"{value:.3g}" if 0.0 < abs(value) < 0.01 else f"{value:.3f}"
    return f"{text} {unit}".rstrip()


def outcome(result: Result) -> str:
    """Return whether threshold or target was missed, and the note of the result."""
    if not result.met:
        missed = "MISSED"
    elif result.target is not None and result.value > result.target:
        missed = "target missed"
    else:
        missed = ""
    return " ".join(part for part in (missed, result.note) if part)


def text_table(measured: Sequence[tuple[Experiment, Sequence[Result]]]) -> str:
    """Return one line per result, in columns."""
    lines = [HEAD]
    for experiment, results in measured:
        for index, result in enumerate(results):
            lines.append(
                (
                    experiment.id if index == 0 else "",
                    result.name,
                    value_text(result.value, result.unit),
                    result.threshold_text,
                    "" if result.target is None else f"{result.target:g}",
                    "" if result.ratio is None else f"{result.ratio:g}",
                    outcome(result),
                )
            )
    widths = [max(len(line[i]) for line in lines) for i in range(len(HEAD))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with a head row; columns after the first are right-aligned."""
    rule = ["---", *["--:"] * (len(rows[0]) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in (rows[0], rule, *rows[1:]))
