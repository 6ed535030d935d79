"""TRC files: marker trajectories exported by motion-capture programs.

Positions are returned in metres, in the axes of the file. A missing marker is NaN. Rows of a file::

    PathFileType  4  (X/Y/Z)  name
    DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame OrigNumFrames
    (their values)
    Frame#  Time  NAME  (two empty cells)  NAME ...
    (two empty cells)  X1  Y1  Z1  X2 ...
    (often an empty row)
    frame  time  x  y  z  x ...
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.text import (
    MalformedFileError,
    cells_of,
    format_instant,
    format_value,
    number,
    read_lines,
    require_times,
    rows_of_numbers,
    separator_of,
    strip_trailing_empty,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

_HEADER_ROWS = 5
_SHOWN = 40
"""Maximum number of characters of a wrong cell in a message."""
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
"""Number of metres per unit of length in marker files."""
_KEYS = (
    "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame OrigNumFrames"
)


@dataclass(frozen=True, slots=True)
class MarkerTrajectories:
    """Marker positions over time."""

    names: tuple[str, ...]
    t_s: NDArray[np.float64]
    """Times as written, s, shape (n,)."""
    frames: NDArray[np.int64]
    """Frame numbers as written, shape (n,)."""
    positions: NDArray[np.float64]
    """Positions in the file's axes, m, shape (n, len(names), 3); NaN where missing."""
    rate_hz: float
    warnings: tuple[str, ...] = ()
    """Descriptions of contradictions between header and rows."""
    residuals: NDArray[np.float64] | None = None
    """Residual of the cameras for every position, m, shape (n, len(names)); NaN where the residual
    is unknown. None if the format has no residuals."""


_MOST_FRAMES = 2.0**53
"""Largest frame number that a float represents exactly."""


def read_trc(path: Path) -> MarkerTrajectories:
    """Return the trajectories of a TRC file with tabs, commas or blanks between cells.

    Raises
    ------
    MalformedFileError
        The file is not TRC, has no markers, two markers of one name, no rows, invalid numbers, or
        an unknown unit of length.
    """
    lines = read_lines(path)
    _require_header(path, lines)
    separator = separator_of(lines[3])
    names = tuple(strip_trailing_empty(cells_of(lines[3], separator))[2::3])
    if not names:
        raise MalformedFileError(
            f"{path}, line 4: no marker names after Frame# and Time: export it again"
        )

    # OpenSim also rejects two markers of one name.
    for name, times in Counter(filter(None, names)).items():
        if times > 1:
            columns = [str(3 + 3 * at) for at, other in enumerate(names) if other == name]
            raise MalformedFileError(
                f"{path}, line 4: marker {name!r} occurs {times} times, in columns"
                f" {' and '.join(columns)}, expected once: rename all but one"
            )

    header_separator = separator_of(lines[1])
    keys, cells = (cells_of(line, header_separator) for line in lines[1:3])
    header = dict(zip(keys, cells, strict=False))
    rate_hz = number(path, 3, header.get("DataRate", ""))
    if not 0.0 < rate_hz < math.inf:
        found = header.get("DataRate", "missing")
        raise MalformedFileError(
            f"{path}, line 3: DataRate is {found}, expected a frame rate in Hz"
        )

    body = enumerate(lines[_HEADER_ROWS:], start=_HEADER_ROWS + 1)
    rows = rows_of_numbers(path, body, separator, 2 + 3 * len(names))
    unit = header.get("Units", "mm").lower()
    if unit not in METRES:
        raise MalformedFileError(f"{path}: Units is {unit!r}, expected one of {', '.join(METRES)}")

    require_times(path, rows[:, 1])
    if not (np.abs(rows[:, 0]) < _MOST_FRAMES).all():
        raise MalformedFileError(
            f"{path}: the first column must hold frame numbers: export the trial again"
        )
    counted = {"NumFrames": len(rows), "NumMarkers": len(names)}
    warnings = tuple(
        f"header {key} is {header.get(key, 'missing')}, counted {count}"
        for key, count in counted.items()
        if header.get(key, "") != str(count)
    )
    return MarkerTrajectories(
        names,
        rows[:, 1],
        rows[:, 0].astype(np.int64),
        rows[:, 2:].reshape(-1, len(names), 3) * METRES[unit],
        rate_hz,
        warnings,
    )


def _require_header(path: Path, lines: Sequence[str]) -> None:
    """Raise `MalformedFileError` unless the lines begin with a complete header."""
    if not lines or not lines[0].startswith("PathFileType"):
        found = lines[0].split("\t")[0][:_SHOWN] if lines else ""
        raise MalformedFileError(
            f"{path}, line 1: not a TRC file: found {found!r}, expected PathFileType in the first "
            "cell: export the trial as TRC again"
        )
    if len(lines) < _HEADER_ROWS:
        raise MalformedFileError(
            f"{path}: ends after line {len(lines)}, expected {_HEADER_ROWS} lines of header and "
            "one line per frame: export the trial again"
        )


def write_trc(path: Path, trajectories: MarkerTrajectories) -> None:
    """Write a TRC file in metres: tabs, 8 significant digits, empty cells for missing markers.

    Every data row ends with a tab. Otherwise OpenSim 4.6 rejects a row whose last marker is
    missing, because it discards the last empty cell.
    """
    count, markers = len(trajectories.t_s), len(trajectories.names)
    rate = format_value(trajectories.rate_hz)
    first = int(trajectories.frames[0]) if count else 1
    header = (rate, rate, count, markers, "m", rate, first, count)

    axes = (f"{axis}{i}" for i in range(1, markers + 1) for axis in "XYZ")
    rows = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        _KEYS.replace(" ", "\t"),
        "\t".join(map(str, header)),
        "\t".join(["Frame#", "Time", *(f"{name}\t\t" for name in trajectories.names)]),
        "\t".join(["", "", *axes]),
        "",
    ]
    flat = trajectories.positions.reshape(count, -1)
    for frame, t_s, cells in zip(trajectories.frames, trajectories.t_s, flat, strict=True):
        values = [str(int(frame)), format_instant(t_s), *map(format_value, cells)]
        rows.append("\t".join([*values, ""]))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
