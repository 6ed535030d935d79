"""Writes joint coordinates and marker errors as OpenSim tables (MOT, STO) and CSV files.

OpenSim cannot read empty cells, so a MOT or STO file contains the known part of the table, see
`files.orientations`. A CSV file contains all columns and frames.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.orientations import TimeTable, WrittenTable, write_known_values
from jointfit_daemon.files.text import format_value

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from jointfit_daemon.tools.ik._solution import TrialSolution

ENDINGS = (".mot", ".sto", ".csv")
ERROR_COLUMNS = ("total_squared_error", "marker_error_RMS", "marker_error_max")
"""Column names in OpenSim's file of marker errors; the values are in m^2 and m."""


def write_tables(
    found: TrialSolution,
    coordinates: Sequence[Path],
    errors: Path | None,
    *,
    with_sd: bool,
    in_degrees: bool,
) -> list[WrittenTable]:
    """Write coordinates and marker errors to the requested files; return one result per file."""
    tables = [
        write_coordinates(path, found, with_sd=with_sd, in_degrees=in_degrees)
        for path in coordinates
    ]
    return tables if errors is None else [*tables, write_errors(errors, found)]


def write_coordinates(
    path: Path, found: TrialSolution, *, with_sd: bool, in_degrees: bool
) -> WrittenTable:
    """Write the coordinates: angles in degrees or rad, translations in m.

    With `with_sd`, a column ``NAME_sd`` for each coordinate follows the coordinates.
    """
    unit = np.where(found.is_angle, np.degrees(1.0) if in_degrees else 1.0, 1.0)
    names, values = found.names, found.values * unit
    if with_sd:
        names = (*names, *(f"{name}_sd" for name in names))
        values = np.concatenate((values, found.sd * unit), axis=1)
    return _write(path, TimeTable(names, found.t_s, values, in_degrees, "Coordinates"))


def write_errors(path: Path, found: TrialSolution) -> WrittenTable:
    """Write sum of squares (m^2), RMS (m) and maximum (m) of the marker errors in each frame."""
    square, seen = found.distances**2, np.isfinite(found.distances)
    total = np.where(seen, square, 0.0).sum(axis=1)
    count = seen.sum(axis=1)
    rms = np.sqrt(total / np.maximum(count, 1))
    most = np.where(seen, found.distances, 0.0).max(axis=1)
    values = np.stack((total, rms, most), axis=1)
    values[~found.solved] = np.nan
    return _write(path, TimeTable(ERROR_COLUMNS, found.t_s, values, False, "ModelMarkerErrors"))


def _write(path: Path, table: TimeTable) -> WrittenTable:
    if path.suffix.lower() == ".csv":
        lines = [
            ",".join(("time", *table.columns)),
            *(
                ",".join(map(format_value, row))
                for row in np.column_stack((table.t_s, table.values))
            ),
        ]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return WrittenTable(path, len(table.t_s))
    return write_known_values(path, table)
