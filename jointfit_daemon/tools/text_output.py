"""Shared output functions of the commands: text tables, JSON on standard output, choices."""

from __future__ import annotations

import shutil
import sys
import textwrap
from typing import TYPE_CHECKING, Any

import orjson
import typer

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence


def echo_json(data: Any) -> None:
    """Print one JSON object on one line; NaN and infinity become null."""
    typer.echo(orjson.dumps(data, option=orjson.OPT_SERIALIZE_NUMPY))


def echo_wrapped(text: str, *, err: bool = False) -> None:
    """Print lines; on a terminal, long lines are wrapped at blanks and indented."""
    if not (sys.stderr if err else sys.stdout).isatty():
        typer.echo(text, err=err)
        return
    columns = shutil.get_terminal_size().columns
    for line in text.split("\n"):
        indent = line[: len(line) - len(line.lstrip())]
        wrapped = textwrap.wrap(
            line, columns, subsequent_indent=indent,
            break_long_words=False, break_on_hyphens=False, drop_whitespace=True,
        )  # fmt: skip
        typer.echo("\n".join(wrapped), err=err)


def align_columns(rows: Sequence[Sequence[str]], right: Collection[int] = ()) -> str:
    """Return rows as text columns; the column indices in `right` are right-aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]

    def line(row: Iterable[str]) -> str:
        cells = (
            cell.rjust(width) if k in right else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        return "  ".join(cells).rstrip()

    return "\n".join(map(line, rows))


def join_choices(names: Sequence[str]) -> str:
    """Return names as ``a, b or c``."""
    return " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def check_choice(option: str, value: str | None, choices: Sequence[str]) -> None:
    """Check the value of an option; None, which means that the option is absent, is valid.

    Raises
    ------
    ValueError
        `value` is not one of `choices`.
    """
    if value is not None and value not in tuple(choices):
        raise ValueError(f"{option} is {value!r}, expected {join_choices(choices)}")
