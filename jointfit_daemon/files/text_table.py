"""Rows of numbers in text files, whoever wrote them: tab, comma or blanks between cells.

Law: an empty cell, or anything that spells "not a number", is missing (NaN). Declared counts are
hints: real files carry wrong ones, so rows are counted, never believed.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

DIGITS = 8
"""Significant digits of what is written."""


class Malformed(ValueError):  # noqa: N818 - named for what happened
    """A file that is not what its name says; the message names file, line and remedy."""


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file without their ends; bytes that are no UTF-8 are replaced."""
    return path.read_text(encoding="utf-8", errors="replace").splitlines()


def separator_of(line: str) -> str | None:
    """Return what separates the cells of a row of column names; None is runs of blanks."""
    return "\t" if "\t" in line else "," if "," in line else None


def cells_of(line: str, separator: str | None) -> list[str]:
    """Return the cells of a row, stripped; trailing empty cells stay (they may be missing data)."""
    if separator is None:
        return line.split()
    return [cell.strip() for cell in line.split(separator)]


def without_trailing_blanks(cells: Sequence[str]) -> list[str]:
    """Return `cells` without the empty ones at the end: padding, not columns."""
    end = len(cells)
    while end and not cells[end - 1]:
        end -= 1
    return list(cells[:end])


def number(cell: str) -> float:
    """Return the number in a cell; NaN if it is empty or says so."""
    return float(cell) if cell else math.nan


def rows_of_numbers(
    path: Path, lines: Iterable[tuple[int, str]], separator: str | None, width: int
) -> NDArray[np.float64]:
    """Return the numbers of all rows, shape (n, width); short rows are filled with NaN.

    Parameters
    ----------
    path
        For messages.
    lines
        Line numbers and lines; empty rows (only separators) are skipped.
    separator
        As `separator_of` found it.
    width
        Columns; further cells are padding and ignored.

    Raises
    ------
    Malformed
        A cell is neither empty nor a number.
    """
    rows: list[list[float]] = []
    for at, line in lines:
        cells = cells_of(line, separator)[:width]
        if not any(cells):
            continue
        try:
            row = [number(cell) for cell in cells]
        except ValueError as error:
            raise Malformed(f"{path}, line {at}: {error}") from error
        rows.append(row + [math.nan] * (width - len(row)))
    return np.array(rows, dtype=np.float64).reshape(-1, width)


def written(value: float) -> str:
    """Return a number as it is written: 8 significant digits, empty if missing."""
    return "" if math.isnan(value) else f"{value:.{DIGITS}g}"
