"""STO and MOT files of OpenSim: tables over time, and tables of orientations.

Numbers, including angles, are returned as written; ``in_degrees`` defines the unit of angles. A
file begins with a header of free text and ``key=value`` lines, which ends with ``endheader``. The
column names and the rows follow. In a table of orientations (``DataType=Quaternion``) every cell is
``w,x,y,z``, a rotation from body to world.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.text import (
    MalformedFileError,
    cells_of,
    format_instant,
    format_value,
    number,
    read_lines,
    reject_sparse_table,
    require_times,
    rows_of_numbers,
    separator_of,
    strip_trailing_empty,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

_ROW_KEYS = ("nrows", "datarows")
_COLUMN_KEYS = ("ncolumns", "datacolumns")
_FIXED_KEYS = {
    *_ROW_KEYS, *_COLUMN_KEYS, "indegrees", "version", "datarate", "datatype", "opensimversion",
}  # fmt: skip
"""Header keys that belong to the format, in lower case."""
_QUATERNION = 4
_UNKNOWN = "nan,nan,nan,nan"
"""Cell of an unknown orientation. OpenSim rejects empty cells, but ignores a sensor with NaN."""
_SHOWN = 60
"""Maximum number of characters of a cell quoted in a message."""


@dataclass(frozen=True, slots=True)
class TimeTable:
    """Named columns over time."""

    columns: tuple[str, ...]
    """Column names without ``time``."""
    t_s: NDArray[np.float64]
    """Times, s, shape (n,)."""
    values: NDArray[np.float64]
    """Numbers as written, shape (n, len(columns)); NaN where missing."""
    in_degrees: bool
    name: str = ""
    """First header line."""
    warnings: tuple[str, ...] = ()
    header: Mapping[str, str] = field(default_factory=dict)
    """Further ``key=value`` lines; keys in lower case."""

    def column(self, name: str) -> NDArray[np.float64]:
        """Return one column, shape (n,); raise ValueError if there is no such column."""
        return self.values[:, self.columns.index(name)]


@dataclass(frozen=True, slots=True)
class OrientationTable:
    """Orientations of several bodies over time."""

    names: tuple[str, ...]
    t_s: NDArray[np.float64]
    """Times, s, shape (n,)."""
    quaternions: NDArray[np.float64]
    """Body orientations q_world_body in the file's axes, shape (n, len(names), 4); NaN where
    missing."""
    rate_hz: float | None = None
    header: Mapping[str, str] = field(default_factory=dict)
    """Further ``key=value`` lines; keys in lower case."""


def read_sto(path: Path) -> TimeTable:
    """Return the table of a STO or MOT file with tabs, commas or blanks between cells.

    Raises
    ------
    MalformedFileError
        The file has no ``endheader``, no column names or no rows, or its first column is not time.
    """
    name, header, columns, separator, body = _open(path)
    rows = rows_of_numbers(path, body, separator, len(columns))
    require_times(path, rows[:, 0])

    counted = {_ROW_KEYS: len(rows), _COLUMN_KEYS: len(columns)}
    doubts = tuple(
        f"header {key} is {header[key]}, counted {count}"
        for keys, count in counted.items()
        for key in keys
        if key in header and header[key] != str(count)
    )

    in_degrees = header.get("indegrees", "no").lower() in {"yes", "true", "1"}
    return TimeTable(
        columns[1:], rows[:, 0], rows[:, 1:], in_degrees, name, doubts, _further(header)
    )


def read_orientations_sto(path: Path) -> OrientationTable:
    """Return the orientations of a STO file with ``DataType=Quaternion``.

    Raises
    ------
    MalformedFileError
        For the reasons given at `read_sto`, or because a cell does not contain four numbers.
    """
    _, header, columns, separator, body = _open(path)
    if header.get("datatype", "").lower() != "quaternion" or separator == ",":
        raise MalformedFileError(
            f"{path}: not a table of orientations: expected DataType=Quaternion in the header and"
            " tabs between the cells"
        )
    times, found, characters = [], [], 0
    for at, line in body:
        cells = strip_trailing_empty(cells_of(line, separator))
        if not cells:
            continue
        times.append(number(path, at, cells[0]))
        found.append([_quaternion(path, at, cell) for cell in cells[1 : len(columns)]])
        characters += len(line)
    t_s = np.array(times, dtype=np.float64)
    require_times(path, t_s)
    reject_sparse_table(
        path, rows=len(found), columns=_QUATERNION * (len(columns) - 1), characters=characters
    )

    quaternions = np.full((len(times), len(columns) - 1, _QUATERNION), np.nan)
    for to, row in zip(quaternions, found, strict=True):
        to[: len(row)] = row or np.empty((0, _QUATERNION))
    rate_hz = number(path, 1, header["datarate"]) if "datarate" in header else None
    return OrientationTable(columns[1:], t_s, quaternions, rate_hz, _further(header))


def _quaternion(path: Path, at: int, cell: str) -> list[float]:
    if not cell:
        return [np.nan] * _QUATERNION
    parts = cell.split(",")
    if len(parts) != _QUATERNION:
        fault = "is not w,x,y,z: correct the cell, or leave it empty"
        if len(parts) > _QUATERNION:
            fault = (
                "is more than w,x,y,z: if it has decimal commas, export the table with decimal"
                " points"
            )
        raise MalformedFileError(f"{path}, line {at}: {cell[:_SHOWN]!r} {fault}")
    return [number(path, at, part) for part in parts]


def _open(
    path: Path,
) -> tuple[str, dict[str, str], tuple[str, ...], str | None, Iterator[tuple[int, str]]]:
    """Return first line, header, column names, separator, and numbered rows."""
    lines = read_lines(path)
    header: dict[str, str] = {}
    end = 0
    for end, line in enumerate(lines):  # noqa: B007 - the index is used after the loop
        plain = line.rstrip(", \t")
        if plain.lower() == "endheader":
            break
        key, equals, value = plain.partition("=")
        if equals:
            header[key.strip().lower()] = value.strip()
    else:
        raise MalformedFileError(
            f"{path}: not a STO or MOT file (no endheader line): export it again"
        )
    if end + 1 >= len(lines):
        raise MalformedFileError(f"{path}: no column names after endheader: export it again")
    separator = separator_of(lines[end + 1])
    columns = tuple(strip_trailing_empty(cells_of(lines[end + 1], separator)))
    if not columns or columns[0].lower() != "time":
        raise MalformedFileError(
            f"{path}, line {end + 2}: the first column must be called time: name it so"
        )
    body = enumerate(lines[end + 2 :], start=end + 3)
    return lines[0].rstrip(", \t"), header, columns, separator, body


def _further(header: Mapping[str, str]) -> dict[str, str]:
    return {key: value for key, value in header.items() if key not in _FIXED_KEYS}


def write_sto(path: Path, table: TimeTable) -> None:
    """Write a STO or MOT file: tabs, 8 significant digits, empty cells for missing values."""
    rows = [
        table.name or path.stem,
        "version=1",
        f"nRows={len(table.t_s)}",
        f"nColumns={1 + len(table.columns)}",
        f"inDegrees={'yes' if table.in_degrees else 'no'}",
        *(f"{key}={value}" for key, value in table.header.items()),
        "endheader",
        "\t".join(("time", *table.columns)),
    ]

    for t_s, values in zip(table.t_s, table.values, strict=True):
        rows.append("\t".join((format_instant(t_s), *map(format_value, values))))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def write_orientations_sto(path: Path, table: OrientationTable) -> None:
    """Write a STO file of quaternions that OpenSim's tool OpenSense can read."""
    rows = [
        *([f"DataRate={format_value(table.rate_hz)}"] if table.rate_hz else []),
        "DataType=Quaternion",
        "version=3",
        "OpenSimVersion=4.4",
        *(f"{key}={value}" for key, value in table.header.items()),
        "endheader",
        "\t".join(("time", *table.names)),
    ]

    for t_s, quaternions in zip(table.t_s, table.quaternions, strict=True):
        cells = (
            _UNKNOWN if np.isnan(q[0]) else ",".join(map(format_value, q)) for q in quaternions
        )
        rows.append("\t".join((format_instant(t_s), *cells)))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
