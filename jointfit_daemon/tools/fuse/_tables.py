"""Tables of orientations from files, and what is wrong with them in words.

Law: whatever the file's axes are, what leaves here has z up. What looks like other units, another
order or another clock is refused with what to change, never converted on a guess.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.orientations import (
    quaternions_z_up,
    read_arrays,
    read_orientations_npz,
    read_orientations_sto,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.nearest_name import unknown_name

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.files.mocap import Axis


SLOWEST_HZ, FASTEST_HZ = 5.0, 20_000.0
NORM_SLACK = 0.05
FEWEST = 30
"""Instants that sensors and reference must share."""


class Unusable(ValueError):  # noqa: N818 - named for what happened
    """A file that is not what was asked for; the message says what to change."""


@dataclass(frozen=True, slots=True)
class Table:
    """Orientations over time by name, z up."""

    t_s: Array
    q: Mapping[str, Array]
    """q_world_sensor by sensor, shape (n, 4) each; NaN where missing."""
    bones: Mapping[str, Array]
    """q_world_segment by bone, likewise; an STO file calls both alike."""


def read_table(path: Path, up: Axis) -> Table:
    """Return all orientations of an NPZ or STO file, z up.

    Raises
    ------
    Unusable
        Another kind of file, or numbers that cannot be unit quaternions over seconds.
    """
    kind = path.suffix.lower()
    if kind == ".npz":
        refuse_odd_arrays(path)
        trial = read_orientations_npz(path)
        table = Table(trial.t_s, trial.sensors, trial.bones)
    elif kind == ".sto":
        said = read_orientations_sto(path)
        columns = {name: said.quaternions[:, k] for k, name in enumerate(said.names)}
        for name, q in columns.items():
            refuse_other_units(path, name, q)
        turn = quaternions_z_up if up == "y" else rotation.normalize
        columns = {name: turn(q) for name, q in columns.items()}
        table = Table(said.t_s, columns, columns)
    else:
        raise Unusable(f"{path}: expected orientations in a file that ends in .npz or .sto")
    _refuse_other_times(path, table.t_s)
    return table


def refuse_odd_arrays(path: Path) -> None:
    """Refuse arrays of an NPZ file that are no unit quaternions, one a row of ``t``."""
    arrays = read_arrays(path)
    count = len(arrays["t"]) if "t" in arrays else None
    for name, array in arrays.items():
        if not (name.endswith("_quat") or name.startswith("q_")):
            continue
        q = np.asarray(array, dtype=np.float64)
        if count is not None and q.shape != (count, 4):
            raise Unusable(
                f"{path}: {name} has shape {q.shape}, expected {(count, 4)}: a quaternion "
                f"w, x, y, z for each of the {count} instants of t; gaps are NaN"
            )
        refuse_other_units(path, name, q)


def refuse_other_units(path: Path, name: str, q: Array) -> None:
    """Refuse what has not the length of unit quaternions."""
    norms = np.linalg.norm(q, axis=-1)
    known = norms[np.isfinite(norms)]
    if known.size and abs(float(np.median(known)) - 1.0) > NORM_SLACK:
        raise Unusable(
            f"{path}: {name}: its four numbers have norm {float(np.median(known)):.3g}, not 1: "
            "expected unit quaternions w, x, y, z, not angles in degrees or radians"
        )


def _refuse_other_times(path: Path, t_s: Array) -> None:
    if len(t_s) < FEWEST:
        raise Unusable(f"{path}: {len(t_s)} rows, at least {FEWEST} are needed")
    steps = np.diff(t_s)
    if not (steps > 0.0).all():
        at = int(np.argmin(steps > 0.0)) + 1
        raise Unusable(
            f"{path}: times must grow from row to row, and row {at + 1} has {t_s[at]:g} s after "
            f"{t_s[at - 1]:g} s: sort the rows and leave out repeated ones"
        )
    rate_hz = 1.0 / float(np.median(steps))
    if not SLOWEST_HZ <= rate_hz <= FASTEST_HZ:
        raise Unusable(
            f"{path}: times {float(np.median(steps)):g} apart would be {rate_hz:.3g} Hz: expected "
            "seconds; are they milliseconds, or frame numbers?"
        )


def sensors_of(table: Table, names: Sequence[str], path: Path) -> dict[str, Array]:
    """Return the sensors of a table; `Unusable` names who is not there, or says nothing at all."""
    if missing := [name for name in names if name not in table.q]:
        free = [name for name in table.q if name not in names]
        said = "; ".join(unknown_name("sensor", name, table.q, candidates=free) for name in missing)
        raise Unusable(f"{path}: {said}")
    silent = [name for name in names if not np.isfinite(table.q[name]).all(axis=1).any()]
    if silent:
        raise Unusable(
            f"{path}: {', '.join(silent)}: no orientation in the whole trial: was it plugged in? "
            "Leave it out of --segment, or leave out the trial"
        )
    return {name: table.q[name] for name in names}


def bones_of(table: Table, names: Sequence[str], path: Path) -> dict[str, Array]:
    """Return the reference orientations of a table; `Unusable` names what is not there."""
    if missing := [name for name in names if name not in table.bones]:
        problems = [unknown_name("reference of segment", name, table.bones) for name in missing]
        raise Unusable(
            f"{path}: {'; '.join(problems)}; if another file has it, write SENSORS=REFERENCE; if"
            " its name differs, --segment NAME=SENSORS:BONE; if there is none, omit the trial"
        )
    return {name: table.bones[name] for name in names}
