"""Writer of tables that OpenSim can read: STO and MOT files without empty cells.

OpenSim rejects empty cells, and its class `Storage` misreads NaN. Invariant: all cells of a written
table are known. Columns that are mostly unknown are omitted first, then frames with unknown values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.orientations._sto import (
    OrientationTable,
    TimeTable,
    write_orientations_sto,
    write_sto,
)
from jointfit_daemon.name_lists import list_names

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

LEAST_KNOWN = 0.5
"""Smallest share of known values in a written column, relative to the frames with at least one
known value."""


@dataclass(frozen=True, slots=True)
class WrittenTable:
    """Result of writing one table."""

    path: Path
    frames: int
    """Number of written frames; 0 if no file was written."""
    notes: tuple[str, ...] = ()
    """Descriptions of the omitted columns and frames."""


def write_known_values(path: Path, table: TimeTable) -> WrittenTable:
    """Write the known part of a table (see `complete_part`), if it contains a frame."""
    rows, columns = complete_part(np.isfinite(table.values))
    if rows.any():
        names = tuple(np.array(table.columns)[columns].tolist())
        values = table.values[rows][:, columns]
        write_sto(path, replace(table, columns=names, t_s=table.t_s[rows], values=values))
    return _outcome(path, table.columns, rows, columns)


def write_known_orientations(path: Path, table: OrientationTable) -> WrittenTable:
    """Write the known part of a table of orientations, in the same way as `write_known_values`."""
    rows, columns = complete_part(np.asarray(np.isfinite(table.quaternions).all(axis=-1)))
    if rows.any():
        names = tuple(np.array(table.names)[columns].tolist())
        q = table.quaternions[rows][:, columns]
        write_orientations_sto(
            path, replace(table, names=names, t_s=table.t_s[rows], quaternions=q)
        )
    return _outcome(path, table.names, rows, columns)


def complete_part(known: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return a part of a table without unknown cells, as the rows and columns to keep.

    A column is kept if it is known in at least `LEAST_KNOWN` of the rows with any known cell. A row
    is kept if all kept columns are known in it.

    Parameters
    ----------
    known
        Mask of the cells that have a value, shape (T, K).

    Returns
    -------
    rows, columns
        Masks of the kept rows and columns, shapes (T,) and (K,). If no column is kept, no row is
        kept.
    """
    count = int(known.any(axis=1).sum())
    columns: NDArray[np.bool_] = known.sum(axis=0) >= max(LEAST_KNOWN * count, 1)
    rows: NDArray[np.bool_] = np.asarray(known[:, columns].all(axis=1) & columns.any())
    return rows, columns


def _outcome(
    path: Path, names: Sequence[str], rows: NDArray[np.bool_], columns: NDArray[np.bool_]
) -> WrittenTable:
    frames, count = int(rows.sum()), len(rows)
    if not frames:
        text = (
            f"{path}: 0 of {count} frames written, because no frame has values in all columns:"
            " write .csv, which may have empty cells"
        )
        return WrittenTable(path, 0, (text,))

    notes = []
    if not columns.all():
        left_out = [name for name, kept in zip(names, columns, strict=True) if not kept]
        notes.append(
            f"{path.name}: left out, because they are known in less than half of the frames:"
            f" {list_names(left_out)}"
        )
    if frames < count:
        notes.append(
            f"{path.name}: {frames} of {count} frames written, the others have unknown values"
        )
    return WrittenTable(path, frames, tuple(notes))
