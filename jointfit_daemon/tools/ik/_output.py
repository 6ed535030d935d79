"""Writes joint coordinates and marker errors: OpenSim's MOT and STO tables, and CSV.

OpenSim reads no empty cells. A MOT or STO file therefore contains only the frames in which all of
its columns are known; a CSV file contains all frames.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.orientations import TimeTable, write_sto
from jointfit_daemon.files.text import written

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.tools.ik._solution import TrialSolution

ENDINGS = (".mot", ".sto", ".csv")
ERROR_COLUMNS = ("total_squared_error", "marker_error_RMS", "marker_error_max")
"""Column names of OpenSim's file of marker errors; m^2 and m."""


def write_coordinates(path: Path, found: TrialSolution, *, with_sd: bool, in_degrees: bool) -> None:
    """Write the coordinates, angles in degrees or rad, translations in m.

    With `with_sd` a column ``NAME_sd`` follows the coordinates for each of them.
    """
    unit = np.where(found.is_angle, np.degrees(1.0) if in_degrees else 1.0, 1.0)
    names, values = found.names, found.values * unit
    if with_sd:
        names = (*names, *(f"{name}_sd" for name in names))
        values = np.concatenate((values, found.sd * unit), axis=1)
    _write(path, TimeTable(names, found.t_s, values, in_degrees, "Coordinates"))


def write_errors(path: Path, found: TrialSolution) -> None:
    """Write sum of squares, RMS and maximum of the marker errors of each frame, m^2 and m."""
    square, seen = found.distances**2, np.isfinite(found.distances)
    total = np.where(seen, square, 0.0).sum(axis=1)
    count = seen.sum(axis=1)
    rms = np.sqrt(total / np.maximum(count, 1))
    most = np.where(seen, found.distances, 0.0).max(axis=1)
    values = np.stack((total, rms, most), axis=1)
    values[~found.solved] = np.nan
    _write(path, TimeTable(ERROR_COLUMNS, found.t_s, values, False, "ModelMarkerErrors"))


def _write(path: Path, table: TimeTable) -> None:
    if path.suffix.lower() == ".csv":
        _write_csv(path, table.columns, np.column_stack((table.t_s, table.values)))
        return
    whole = np.isfinite(table.values).all(axis=1)
    write_sto(
        path,
        TimeTable(
            table.columns, table.t_s[whole], table.values[whole], table.in_degrees, table.name
        ),
    )


def _write_csv(path: Path, columns: tuple[str, ...], rows: Array) -> None:
    lines = [",".join(("time", *columns)), *(",".join(map(written, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
