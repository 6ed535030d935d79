"""Marker weights in files: a TOML table, or the tasks of an OpenSim set-up file."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING

from jointfit_daemon.files.models._osim_tasks import read_ik_setup
from jointfit_daemon.files.text import MalformedFileError, read_toml

if TYPE_CHECKING:
    from pathlib import Path


def read_marker_weights(path: Path) -> dict[str, float]:
    """Return the weights by marker name; each one multiplies the squared error of its marker.

    Parameters
    ----------
    path : Path
        ``.xml``: an OpenSim set-up file for inverse kinematics. ``.toml``: lines ``NAME = WEIGHT``.

    Raises
    ------
    MalformedFileError
        The file is damaged, or a weight is not a number of at least 0.
    """
    if path.suffix.lower() == ".xml":
        return read_ik_setup(path).weights
    weights = {}
    for name, value in read_toml(path).items():
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if not number or not isfinite(value) or value < 0.0:
            raise MalformedFileError(
                f"{path}: {name}: weight is {value!r}, expected a number of 0 or more: write"
                f' "{name}" = 1.0'
            )
        weights[name] = float(value)
    return weights
