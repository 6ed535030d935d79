"""Generates pages of the documentation from templates: ``python -m bench.framework.pages``.

A template in ``bench/pages`` is Markdown with fields in double braces:

``{{value: ID | RESULT}}``
    A value with its unit, with two or three significant digits.
``{{value: ID | RESULT | N}}``
    A value with its unit, with N decimals.
``{{range: ID ... | ENDING}}``
    Smallest and largest value among the results of several experiments whose names end with ENDING.
``{{range: ID ... | ENDING | N}}``
    The same values, with N decimals.
``{{experiment: ID ...}}``
    Title, subjects, reference, command and table of each experiment.
``{{speed: ID ...}}``
    One table of times and targets for all experiments.
``{{missed}}``
    A table of all missed thresholds and targets, with reasons.
``{{machine}}``
    The machine on which the times were measured.

Invariant: a page contains no measured value that does not come from ``bench/results``.
"""

from __future__ import annotations

import re
import sys
from functools import cache
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

from bench.framework import storage
from bench.framework.growth_plot import growth_plot
from bench.framework.table import markdown_table, value_text

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from bench.framework.experiment import Result

ROOT = Path(__file__).resolve().parents[2]
TEMPLATES = ROOT / "bench" / "pages"
FIELD = re.compile(r"\{\{(\w+)(?:: *(.*?))?\}\}", re.DOTALL)
UNITS = {"deg": "°", "us": " µs", "": ""}
"""Text after a value, by unit. For a unit that is not listed, it is a space and the unit."""
PIVOT_ROWS = 2
"""Minimum number of rows at which results named ``A: B`` become a table with one row for each A."""


class TemplateError(ValueError):
    """A template has a field that cannot be filled."""


def write(docs: Path = ROOT / "docs") -> list[Path]:
    """Generate all pages below `docs`; return the paths of changed pages."""
    changed = []
    for name, text in render_all().items():
        path = docs / name
        path.parent.mkdir(exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            changed.append(path)
    return changed


def render_all() -> dict[str, str]:
    """Return the generated pages and drawings, by their path below docs."""
    stored.cache_clear()
    written = {
        path.relative_to(TEMPLATES).as_posix(): render(path.read_text(encoding="utf-8"))
        for path in sorted(TEMPLATES.rglob("*.md"))
    }
    return written | {"pictures/growth.svg": growth_plot()}


def render(template: str) -> str:
    """Return the template with its fields filled from the stored results."""
    return FIELD.sub(lambda found: _field(found[1], (found[2] or "").strip()), template)


def _field(kind: str, argument: str) -> str:
    match kind:
        case "value":
            return _value(*_parts(argument))
        case "range":
            return _range(*_parts(argument))
        case "experiment":
            return "\n\n".join(_experiment(name) for name in argument.split())
        case "speed":
            return _speed(argument.split())
        case "missed":
            return _missed()
        case "machine":
            return _machine()
        case _:
            msg = f"unknown field {kind!r} in a template of {TEMPLATES}"
            raise TemplateError(msg)


def _parts(argument: str) -> list[str]:
    """Return the parts of a field, whose separator is escaped in a Markdown table."""
    return [part.strip() for part in argument.replace("\\|", "|").split("|")]


@cache
def stored(name: str) -> dict[str, Any]:
    """Return the stored results of an experiment."""
    try:
        return storage.load(name)
    except FileNotFoundError:
        msg = f"no results of {name!r} in {storage.RESULTS}: run `python -m bench {name}`"
        raise TemplateError(msg) from None


def _value(name: str, result: str, decimals: str = "") -> str:
    for found in storage.results_of(stored(name)):
        if found.name == result:
            break
    else:
        msg = f"{name} has no result {result!r}"
        raise TemplateError(msg)
    unit = UNITS.get(found.unit, f" {found.unit}")
    if decimals:
        return f"{found.value:.{int(decimals)}f}{unit}"
    digits = 2 if abs(found.value) < 10 else 3
    return f"{found.value:.{digits}g}{unit}"


def _range(names: str, ending: str, decimals: str = "0") -> str:
    results = [result for name in names.split() for result in storage.results_of(stored(name))]
    found = sorted(
        (result for result in results if result.name.endswith(ending)), key=lambda r: r.value
    )
    if not found:
        msg = f"no result of {names} ends with {ending!r}"
        raise TemplateError(msg)
    first, last = (f"{result.value:.{int(decimals)}f}" for result in (found[0], found[-1]))
    return f"{first} to {last}{UNITS.get(found[0].unit, f' {found[0].unit}')}"


def _experiment(name: str) -> str:
    content = stored(name)
    results = storage.results_of(content)
    lines = [
        f"### {name}",
        "",
        f"{content['title']}. Subjects: {content['subjects']}. Reference: {content['reference']}. "
        f"Repeat with `{content['command']}`.",
        "",
        table_of(results),
    ]
    return "\n".join(lines)


def table_of(results: Sequence[Result]) -> str:
    """Return the results as a matrix if their names are ``row: column``, or else as a list."""
    split = [result.name.rpartition(": ") for result in results]
    rows = list(dict.fromkeys(row for row, _, _ in split))
    columns = list(dict.fromkeys(column for _, _, column in split))
    notes = any(result.note for result in results)
    if (
        "" in rows
        or notes
        or len(rows) < PIVOT_ROWS
        or len(results) * 3 < 2 * len(rows) * len(columns)
    ):
        return _list(results)
    cells = {(row, column): result for (row, _, column), result in zip(split, results, strict=True)}
    table = [["", *columns]]
    for row in rows:
        found = [cells.get((row, column)) for column in columns]
        table.append([row, *("" if result is None else _cell(result) for result in found)])
    return markdown_table(table)


def _cell(result: Result) -> str:
    text = _number(result)
    if result.threshold_text != "–":
        text += f" ({result.threshold_text})"
    return text if result.met else f"**{text}, missed**"


def _number(result: Result) -> str:
    return "unbounded" if abs(result.value) == inf else value_text(result.value, result.unit)


def _list(results: Sequence[Result]) -> str:
    table = [["result", "value", "threshold"]]
    for result in results:
        value = _number(result) if result.met else f"**{_number(result)}, missed**"
        note = f" ({result.note})" if result.note else ""
        table.append([result.name + note, value, result.threshold_text])
    return markdown_table(table)


def _speed(names: Sequence[str]) -> str:
    table = [["", "measured", "target", "× loop"]]
    for name in names:
        for result in storage.results_of(stored(name)):
            missed = result.target is not None and result.value > result.target
            value = f"{result.value:g} {result.unit}".rstrip()
            table.append(
                [
                    result.name + (f" ({result.note})" if result.note else ""),
                    f"**{value}: target missed**" if missed else value,
                    "" if result.target is None else f"{result.target:g}",
                    "" if result.ratio is None else f"{result.ratio:.2g}",
                ]
            )
    return markdown_table(table)


def _missed() -> str:
    table = [["experiment", "result", "value", "threshold", "reason"]]
    for path in sorted(storage.RESULTS.glob("*.json")):
        if path.stem == storage.MACHINE:
            continue
        content = stored(path.stem)
        reasons = {entry["name"]: entry.get("reason", "not known") for entry in content["results"]}
        table += [
            [
                f"`{path.stem}`",
                result.name,
                _number(result),
                result.threshold_text,
                reasons[result.name],
            ]
            for result in storage.results_of(content)
            if not result.met
        ]
    rule = ["---", "---", "--:", "--:", "---"]
    return "\n".join(f"| {' | '.join(row)} |" for row in (table[0], rule, *table[1:]))


def _machine() -> str:
    found = stored(storage.MACHINE)
    libraries = ", ".join(f"{name} {version}" for name, version in found["libraries"].items())
    return (
        f"{found['processor']}, {found['cores']} cores, {found['system']}, Python "
        f"{found['python']}, fixed loop {found['fixed_loop_us']:g} µs, {libraries}"
    )


if __name__ == "__main__":
    for changed in write():
        print(f"written: {changed.relative_to(ROOT)}")
    sys.exit(0)
