"""Marker trials from TRC or C3D files, in metres with z up.

The result records the source of the vertical axis: the file, the caller, or the convention of the
format. A marker exactly at the origin is treated as missing (NaN), because some programs write
missing markers in this way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, cast

import numpy as np

from jointfit_daemon.files.axes import Axis, from_z_up, to_z_up
from jointfit_daemon.files.mocap._c3d import read_c3d
from jointfit_daemon.files.mocap._trc import MarkerTrajectories, read_trc
from jointfit_daemon.files.text import MalformedFileError
from jointfit_daemon.nearest_name import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray


class UnknownMarkerError(ValueError):
    """A marker name does not exist in the trial; the message lists similar names."""


@dataclass(frozen=True, slots=True)
class MarkerTrial:
    """Marker positions over time in a world with z up."""

    trajectories: MarkerTrajectories
    """Positions rotated to z up, m; NaN where missing."""
    up_axis: Axis
    """Vertical axis of the file, which became z."""
    up_said_by: Literal["file", "caller", "convention of the format"]
    """Source of `up_axis`."""

    def points(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Return the trajectories of markers by name, m, shape (n, len(names), 3).

        The prefix of a subject may be omitted if the short name is unambiguous: ``LASI`` finds
        ``Tom:LASI``.

        Raises
        ------
        UnknownMarkerError
            Some names are unknown; the message lists them, each with similar names.
        """
        wanted = [self._index(name) for name in names]
        unknown = [name for name, at in zip(names, wanted, strict=True) if at is None]
        if not unknown:
            return self.trajectories.positions[:, [at for at in wanted if at is not None]]

        # For each unknown name the message suggests similar markers, then lists all markers.
        # Markers that were also requested are not suggested.
        taken = set(names)
        free = [n for n in self.trajectories.names if not {n, _bare(n)} & taken]
        spellings = [*free, *map(_bare, free)]
        hints = [did_you_mean(name, spellings, count=3) for name in unknown]
        problems = [
            f"no marker {name!r}" + (f": {hint}" if hint else "")
            for name, hint in zip(unknown, hints, strict=True)
        ]
        problems.append(f"there are: {', '.join(self.trajectories.names)}")
        raise UnknownMarkerError("; ".join(problems))

    def residuals(self, names: Sequence[str]) -> NDArray[np.float64] | None:
        """Return the camera residuals of the named markers, m, shape (n, len(names)).

        The result is None if the file contains no residuals. Missing residuals are NaN.
        """
        found = self.trajectories.residuals
        wanted = [self._index(name) for name in names]
        return None if found is None else found[:, [at for at in wanted if at is not None]]

    def direction(self, axis: Axis) -> NDArray[np.float64]:
        """Return the direction of an axis of the file in the world with z up, shape (3,)."""
        return to_z_up(np.eye(3)["xyz".index(axis)], self.up_axis)

    def to_file(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert vectors (..., 3) from z up to the axes of the file."""
        return from_z_up(vectors, self.up_axis)

    def _index(self, name: str) -> int | None:
        if name in self.trajectories.names:
            return self.trajectories.names.index(name)
        bare = [at for at, full in enumerate(self.trajectories.names) if _bare(full) == name]
        return bare[0] if len(bare) == 1 else None


def _bare(name: str) -> str:
    return name.rpartition(":")[2]


def read_marker_trial(path: Path, up_axis: Axis | None = None) -> MarkerTrial:
    """Return the trial of a ``.trc`` or ``.c3d`` file.

    Parameters
    ----------
    path
        File in mm, cm or m.
    up_axis
        Vertical axis of the file. By default a C3D file's declared axis is used, or z if it
        declares none. The default for TRC files is y, the convention of OpenSim.

    Raises
    ------
    MalformedFileError
        The file is neither TRC nor C3D, or is damaged.
    MissingPackageError
        The optional C3D reader is not installed.
    """
    kind = path.suffix.lower()
    if kind == ".trc":
        trajectories, declared, custom = read_trc(path), None, "y"
    elif kind == ".c3d":
        found = read_c3d(path)
        trajectories, declared, custom = found.trajectories, found.up_axis, "z"
    else:
        recorded = path.is_dir() or ".mcap" in path.suffixes
        remedy = ": export the recording with jointfit export --to trc" if recorded else ""
        raise MalformedFileError(f"{path}: expected a file that ends in .trc or .c3d{remedy}")

    up = cast("Axis", up_axis or declared or custom)
    turned = to_z_up(trajectories.positions, up)
    turned[(turned == 0.0).all(axis=-1)] = np.nan
    return MarkerTrial(
        replace(trajectories, positions=turned),
        up,
        "caller" if up_axis else "file" if declared else "convention of the format",
    )
