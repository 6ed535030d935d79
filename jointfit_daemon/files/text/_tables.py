"""Rows of numbers in text files, whoever wrote them: tab, comma or blanks between cells.

Invariants: every fault of a file is `MalformedFileError`; memory grows with the size of the file,
whatever its header claims. An empty cell, or anything that spells "not a number", is missing (NaN).
Declared counts are hints: real files carry wrong ones, so rows are counted, never believed.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

_CELLS_PER_CHARACTER = 16
_FEW_CELLS = 1_000_000
"""Tables up to this size may have rows that are mostly missing; larger ones must hold data."""
_SHOWN = 40  # characters of a cell in a message
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")

DIGITS = 8
"""Significant digits of what is written."""


class MalformedFileError(ValueError):
    """A file that is not what its name says; the message names file, line and remedy."""


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file without their ends; bytes that are no UTF-8 are replaced.

    A byte order mark is left out.

    Raises
    ------
    MalformedFileError
        A device instead of a file, or UTF-16.
    """
    reject_device(path)
    data = path.read_bytes()
    if data.startswith(_UTF_16):
        raise MalformedFileError(f"{path}: is UTF-16 text, expected UTF-8: save it as UTF-8")
    return data.decode("utf-8-sig", errors="replace").splitlines()


def reject_device(path: Path) -> None:
    """Refuse devices and sockets, which may never end.

    Raises
    ------
    MalformedFileError
        `path` is one.
    """
    if path.is_char_device() or path.is_block_device() or path.is_socket():
        raise MalformedFileError(
            f"{path}: is a device or a socket, expected a file: check the path"
        )


def separator_of(line: str) -> str | None:
    """Return what separates the cells of a row of column names; None is runs of blanks."""
    return "\t" if "\t" in line else "," if "," in line else None


def cells_of(line: str, separator: str | None) -> list[str]:
    """Return the cells of a row, stripped; trailing empty cells stay (they may be missing data)."""
    if separator is None:
        return line.split()
    return [cell.strip() for cell in line.split(separator)]


def strip_trailing_empty(cells: Sequence[str]) -> list[str]:
    """Return `cells` without the empty ones at the end: padding, not columns."""
    end = len(cells)
    while end and not cells[end - 1]:
        end -= 1
    return list(cells[:end])


def number(path: Path, at: int, cell: str) -> float:
    """Return the number in a cell of line `at`; NaN if it is empty or says so.

    Raises
    ------
    MalformedFileError
        It is none; a decimal comma is named as such.
    """
    try:
        return float(cell) if cell else math.nan
    except ValueError:
        shown = cell if len(cell) <= _SHOWN else f"{cell[:_SHOWN]}…"
        remedy = "correct the cell, or leave it empty"
        if "," in cell and _is_number(cell.replace(",", ".", 1)):
            remedy = "it has a decimal comma: export the table with decimal points"
        raise MalformedFileError(f"{path}, line {at}: {shown!r} is no number: {remedy}") from None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def reject_sparse_table(path: Path, *, rows: int, columns: int, characters: int) -> None:
    """Refuse a table that would take far more memory than its file.

    Raises
    ------
    MalformedFileError
        Nearly all cells are missing.
    """
    if rows * columns > max(_FEW_CELLS, _CELLS_PER_CHARACTER * characters):
        raise MalformedFileError(
            f"{path}: {rows} rows for {columns} columns, nearly all of them empty: does the row of"
            " names belong to this table?"
        )


def require_times(path: Path, t_s: NDArray[np.float64]) -> None:
    """Refuse a table without rows, or with a time that is missing.

    Raises
    ------
    MalformedFileError
        Either is so.
    """
    if not len(t_s):
        raise MalformedFileError(f"{path}: a header without rows of data: export the trial again")
    if not np.isfinite(t_s).all():
        row = int(np.argmin(np.isfinite(t_s))) + 1
        raise MalformedFileError(
            f"{path}: row {row} of the data has no time: correct it, or leave it out"
        )


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
    MalformedFileError
        A cell is neither empty nor a number; nearly all cells are missing.
    """
    rows: list[list[float]] = []
    characters = 0
    for at, line in lines:
        cells = cells_of(line, separator)[:width]
        if any(cells):
            rows.append([number(path, at, cell) for cell in cells])
            characters += len(line)
    reject_sparse_table(path, rows=len(rows), columns=width, characters=characters)

    table = np.full((len(rows), width), np.nan)
    for to, row in zip(table, rows, strict=True):
        to[: len(row)] = row
    return table


def written(value: float) -> str:
    """Return a number as it is written: 8 significant digits, empty if missing."""
    return "" if math.isnan(value) else f"{value:.{DIGITS}g}"
