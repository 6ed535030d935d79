"""Reads orientation recordings (NPZ, STO) and checks units, order and sampling times.

Invariants: returned orientations have z up. An implausible unit, component order or time raises
`UnusableInputError`; values are never converted to another unit or order.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.axes import quaternions_to_z_up
from jointfit_daemon.files.orientations import (
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
    from jointfit_daemon.files.axes import Axis


SLOWEST_HZ, FASTEST_HZ = 5.0, 20_000.0
"""Range of plausible sampling rates, Hz; other rates indicate times in another unit than
seconds."""
NORM_SLACK = 0.05
"""Largest accepted deviation of the median quaternion norm from 1."""
FEWEST = 30
"""Smallest number of rows of a recording, and of samples that sensors and reference share."""


class UnusableInputError(ValueError):
    """Input that cannot be used; the message names file, finding, expectation and remedy."""


@dataclass(frozen=True, slots=True)
class OrientationRecording:
    """Orientations over time by sensor and by bone, in a world with z up."""

    t_s: Array
    q: Mapping[str, Array]
    """Sensor orientations q_world_sensor by sensor, shape (n, 4) each; NaN where missing."""
    bones: Mapping[str, Array]
    """Segment orientations q_world_segment by bone, shape (n, 4) each. For an STO file, they are
    equal to `q`."""
    origins: Mapping[str, Array] = field(default_factory=dict)
    """Proximal joint center of each bone, m, shape (n, 3); NaN where missing."""


def read_recording(path: Path, up: Axis) -> OrientationRecording:
    """Return all orientations of an NPZ or STO file, z up.

    Raises
    ------
    UnusableInputError
        The file type is unsupported, or the values are not unit quaternions with times in seconds.
    """
    kind = path.suffix.lower()
    if kind == ".npz":
        trial = read_orientations_npz(path)
        for name, array in read_arrays(path).items():  # not in `trial`, which is normalized
            if name.endswith("_quat") or name.startswith("q_"):
                check_unit_norm(path, name, np.asarray(array, dtype=np.float64))
        table = OrientationRecording(trial.t_s, trial.sensors, trial.bones, trial.origins)
    elif kind == ".sto":
        sto = read_orientations_sto(path)
        columns = {name: sto.quaternions[:, k] for k, name in enumerate(sto.names)}
        for name, q in columns.items():
            check_unit_norm(path, name, q)
        turn = quaternions_to_z_up if up == "y" else rotation.normalize
        columns = {name: turn(q) for name, q in columns.items()}
        table = OrientationRecording(sto.t_s, columns, columns)
    else:
        raise UnusableInputError(f"{path}: expected orientations in an .npz or .sto file")

    _check_times(path, table.t_s)
    return table


def check_unit_norm(path: Path, name: str, q: Array) -> None:
    """Check that the median norm is 1 within `NORM_SLACK`."""
    norms = np.linalg.norm(q, axis=-1)
    known = norms[np.isfinite(norms)]
    if known.size and abs(float(np.median(known)) - 1.0) > NORM_SLACK:
        raise UnusableInputError(
            f"{path}: {name}: median norm {float(np.median(known)):.3g}, expected 1: store unit "
            "quaternions (w, x, y, z), not angles in degrees or radians"
        )


def _check_times(path: Path, t_s: Array) -> None:
    if len(t_s) < FEWEST:
        rows = "row" if len(t_s) == 1 else "rows"
        raise UnusableInputError(
            f"{path}: {len(t_s)} {rows}, expected at least {FEWEST}: export the whole trial, or "
            "record a longer one"
        )

    steps = np.diff(t_s)
    if not (steps > 0.0).all():
        at = int(np.argmin(steps > 0.0)) + 1
        raise UnusableInputError(
            f"{path}: row {at + 1} has time {t_s[at]:g} s after {t_s[at - 1]:g} s, expected "
            "increasing times: sort the rows and remove repeated ones"
        )

    rate_hz = 1.0 / float(np.median(steps))
    if not SLOWEST_HZ <= rate_hz <= FASTEST_HZ:
        raise UnusableInputError(
            f"{path}: median time step {float(np.median(steps)):g} s ({rate_hz:.3g} Hz): expected "
            "times in seconds, not milliseconds or frame numbers"
        )


def select_sensors(
    table: OrientationRecording, names: Sequence[str], path: Path
) -> dict[str, Array]:
    """Return the orientations of `names`; raise `UnusableInputError` if one is missing or empty."""
    if missing := [name for name in names if name not in table.q]:
        free = [name for name in table.q if name not in names]
        problems = "; ".join(
            unknown_name("sensor", name, table.q, candidates=free) for name in missing
        )
        raise UnusableInputError(f"{path}: {problems}")

    empty = [name for name in names if not np.isfinite(table.q[name]).all(axis=1).any()]
    if empty:
        raise UnusableInputError(
            f"{path}: {', '.join(empty)}: no orientation in the whole trial: omit the "
            "sensor from --segment, or omit the trial"
        )

    return {name: table.q[name] for name in names}


def select_references(
    table: OrientationRecording, names: Sequence[str], path: Path
) -> dict[str, Array]:
    """Return the references of `names`; raise `UnusableInputError` if a reference is missing."""
    if missing := [name for name in names if name not in table.bones]:
        problems = [unknown_name("reference of segment", name, table.bones) for name in missing]
        raise UnusableInputError(
            f"{path}: {'; '.join(problems)}; if another file contains the reference, write"
            " SENSORS=REFERENCE; if the reference has another name, write --segment"
            " NAME=SENSORS:BONE; if there is no reference, omit the trial"
        )
    return {name: table.bones[name] for name in names}
