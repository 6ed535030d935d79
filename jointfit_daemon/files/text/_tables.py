"""Tables of numbers in text files, with cells separated by tab, comma or blanks.

Invariants: every fault of a file raises `MalformedFileError`. The memory used is proportional to
the size of the file, whatever size the file declares. An empty cell and any spelling of NaN are
missing values (NaN). Declared counts are often wrong in real files, so rows are counted.
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
"""Maximum number of table cells per character of the file."""
_FEW_CELLS = 1_000_000
"""Number of cells up to which nearly all values may be missing. Larger tables must contain data."""
_SHOWN = 40
"""Maximum number of characters of a cell quoted in a message."""
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")

DIGITS = 8
"""Number of significant digits of written numbers."""


class MalformedFileError(ValueError):
    """The content of a file is invalid; the message names the file, the line and the remedy."""


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file without line ends or byte order mark.

    Bytes that are not UTF-8 are replaced.

    Raises
    ------
    MalformedFileError
        The path is a device, or the text is UTF-16.
    """
    reject_device(path)
    data = path.read_bytes()
    if data.startswith(_UTF_16):
        raise MalformedFileError(f"{path}: is UTF-16 text, expected UTF-8: save it as UTF-8")
    return data.decode("utf-8-sig", errors="replace").splitlines()


def reject_device(path: Path) -> None:
    """Raise an error for devices and sockets, whose data may never end.

    Raises
    ------
    MalformedFileError
        `path` is a device or a socket.
    """
    if path.is_char_device() or path.is_block_device() or path.is_socket():
        raise MalformedFileError(
            f"{path}: is a device or a socket, expected a file: check the path"
        )


def separator_of(line: str) -> str | None:
    """Return the separator in a line of column names; None if the names are separated by blanks."""
    return "\t" if "\t" in line else "," if "," in line else None


def cells_of(line: str, separator: str | None) -> list[str]:
    """Return the stripped cells of a row, including empty cells at the end (missing data)."""
    if separator is None:
        return line.split()
    return [cell.strip() for cell in line.split(separator)]


def strip_trailing_empty(cells: Sequence[str]) -> list[str]:
    """Return `cells` without the empty cells at the end, which are padding."""
    end = len(cells)
    while end and not cells[end - 1]:
        end -= 1
    return list(cells[:end])


def number(path: Path, at: int, cell: str) -> float:
    """Return the number in a cell of line `at`; NaN if the cell is empty or spells NaN.

    Raises
    ------
    MalformedFileError
        The cell is not a number. If it has a decimal comma, the message says so.
    """
    try:
        return float(cell) if cell else math.nan
    except ValueError:
        shown = cell if len(cell) <= _SHOWN else f"{cell[:_SHOWN]}…"
        remedy = "correct the cell, or leave it empty"
        if "," in cell and _is_number(cell.replace(",", ".", 1)):
            remedy = "it has a decimal comma: export the table with decimal points"
        raise MalformedFileError(
            f"{path}, line {at}: {shown!r} is not a number: {remedy}"
        ) from None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def reject_sparse_table(path: Path, *, rows: int, columns: int, characters: int) -> None:
    """Raise an error for a table that would need far more memory than its file.

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
    """Raise an error for a table without rows or with a missing time.

    Raises
    ------
    MalformedFileError
        The table has no rows, or a time is missing.
    """
    if not len(t_s):
        raise MalformedFileError(f"{path}: contains no rows of data: export the trial again")
    if not np.isfinite(t_s).all():
        row = int(np.argmin(np.isfinite(t_s))) + 1
        raise MalformedFileError(
            f"{path}: row {row} of the data has no time: correct it, or leave it out"
        )


def read_columns(
    path: Path, lines: Sequence[str], at: int
) -> tuple[list[str], dict[str, NDArray[np.float64]]]:
    """Return the column names in line `at`, and the columns below it by name, shape (n,).

    Raises
    ------
    MalformedFileError
        For the reasons given at `rows_of_numbers`.
    """
    separator = separator_of(lines[at])
    names = strip_trailing_empty(cells_of(lines[at], separator))
    rows = rows_of_numbers(path, enumerate(lines[at + 1 :], at + 2), separator, len(names))
    return names, {name: rows[:, k] for k, name in enumerate(names)}


def rows_of_numbers(
    path: Path, lines: Iterable[tuple[int, str]], separator: str | None, width: int
) -> NDArray[np.float64]:
    """Return the numbers of all rows, shape (n, width); short rows are padded with NaN.

    Parameters
    ----------
    path
        File that error messages name.
    lines
        Line numbers and lines. Rows that contain only separators are skipped.
    separator
        Separator as returned by `separator_of`.
    width
        Number of columns. Further cells are padding, and are ignored.

    Raises
    ------
    MalformedFileError
        A cell is neither empty nor a number, or nearly all cells are missing.
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


def format_value(value: float) -> str:
    """Return a number as text with 8 significant digits; empty if the number is missing."""
    return "" if math.isnan(value) else f"{value:.{DIGITS}g}"


def format_instant(t_s: float) -> str:
    """Return an instant as text with a resolution of 1 ns, without trailing zeros."""
    return f"{t_s:.9f}".rstrip("0").rstrip(".")
