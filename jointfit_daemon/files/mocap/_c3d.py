"""C3D files: marker trials, read with the optional package ``c3d``.

Positions are returned in metres, in the axes of the file. A point with a negative residual is
missing (NaN), whatever its coordinates. A positive residual is the residual that the cameras
reported. Times follow the frame numbers: frame 1 is at 0 s, as in a TRC file of the same trial.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.files.mocap._c3d_writer import C3dEvent
from jointfit_daemon.files.mocap._trc import METRES, MarkerTrajectories
from jointfit_daemon.files.text import MalformedFileError, reject_device

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


class MissingPackageError(ImportError):
    """The optional package for this file format is not installed; the message names the package."""


@dataclass(frozen=True, slots=True)
class C3dTrial:
    """Content of a C3D file."""

    trajectories: MarkerTrajectories
    up_axis: str | None
    """Axis that points up on the screen, "x", "y" or "z"; None if the file declares none."""
    events: tuple[C3dEvent, ...] = ()
    """Events in the order of the file."""
    own_texts: Mapping[str, str] = field(default_factory=dict)
    """Parameters of the group JOINTFIT."""


def read_c3d(path: Path) -> C3dTrial:
    """Return points and events of a C3D file.

    Labels are returned as written (``Subject:LASI``). Frame numbers and `t_s` start at the first
    frame of the trial, whose number is often larger than 1. Analog channels are ignored.

    Raises
    ------
    MissingPackageError
        The package ``c3d`` is not installed.
    MalformedFileError
        The file is not C3D, is damaged, contains no points, or has an unknown unit of length.
    """
    try:
        import c3d  # noqa: PLC0415 - optional, and slow to import
    except ModuleNotFoundError as missing:
        raise MissingPackageError(
            f"{path}: reading C3D needs a package: pip install 'jointfitd[c3d]'"
        ) from missing
    reject_device(path)
    with path.open("rb") as handle, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # c3d warns about every file without analog channels
        try:
            return _read(path, c3d.Reader(handle))
        except MalformedFileError:
            raise
        except Exception as fault:
            raise MalformedFileError(
                f"{path}: not a C3D file, or cut off: export it again"
            ) from fault


def _read(path: Path, reader: Any) -> C3dTrial:
    names = _labels(reader)
    if not names:
        raise MalformedFileError(
            f"{path}: no points with labels in this C3D file: export it with markers"
        )
    unit = (_text(reader, "POINT:UNITS") or "mm").lower()
    if unit not in METRES:
        raise MalformedFileError(
            f"{path}: POINT:UNITS is {unit!r}, expected one of {', '.join(METRES)}"
        )
    frames = [points[: len(names), :4].copy() for _, points, _ in reader.read_frames(copy=False)]
    if not frames:
        raise MalformedFileError(f"{path}: contains no frames: export the trial again")

    cells = np.array(frames, dtype=np.float64).reshape(-1, len(names), 4)
    first, rate_hz = int(reader.first_frame), float(reader.point_rate)
    if not 0.0 < rate_hz < math.inf:
        raise MalformedFileError(
            f"{path}: POINT:RATE is {rate_hz:g}, expected a frame rate in Hz: export it again"
        )

    declared = int(reader.last_frame) - first + 1
    if len(cells) < declared:
        raise MalformedFileError(
            f"{path}: cut off: the header declares {declared} frames, the file holds {len(cells)}:"
            " copy or export it again"
        )

    positions = cells[..., :3].copy()
    positions[cells[..., 3] < 0.0] = np.nan
    # The C3D format defines a residual of 0 for points that were interpolated or filtered.
    residuals = np.where(cells[..., 3] > 0.0, cells[..., 3], np.nan) * METRES[unit]
    numbers = np.arange(first, first + len(cells), dtype=np.int64)
    trajectories = MarkerTrajectories(
        names,
        (numbers - 1) / rate_hz,
        numbers,
        positions * METRES[unit],
        rate_hz,
        ()
        if len(cells) == declared
        else (f"header declares {declared} frames, counted {len(cells)}",),
        residuals if np.isfinite(residuals).any() else None,
    )
    screen = _text(reader, "POINT:Y_SCREEN").lstrip("+").lower()
    group = reader.get("JOINTFIT")
    keys = () if group is None else group.param_keys()
    own = {name: _text(reader, f"JOINTFIT:{name}") for name in keys}
    return C3dTrial(
        trajectories, screen if screen in ("x", "y", "z") else None, _events(reader), own
    )


def _labels(reader: Any) -> tuple[str, ...]:
    """Return the labels of the points. Labels after the first 255 are in LABELS2, LABELS3, ..."""
    names: tuple[str, ...] = ()
    for suffix in ("", *map(str, range(2, 257))):
        found = reader.get(f"POINT:LABELS{suffix}")
        if found is None:
            break
        names += tuple(str(label).strip() for label in found.string_array)
    return names[: reader.point_used]


def _events(reader: Any) -> tuple[C3dEvent, ...]:
    """Return the events that have a time. The file stores a time as minutes and seconds."""
    times = reader.get("EVENT:TIMES")
    if times is None:
        return ()
    pairs = np.asarray(times.float_array, dtype=np.float64).reshape(-1, 2)
    columns = []
    for name in ("LABELS", "CONTEXTS", "DESCRIPTIONS"):
        found = reader.get(f"EVENT:{name}")
        texts = [] if found is None else [str(text).strip() for text in found.string_array]
        columns.append([*texts, *[""] * (len(pairs) - len(texts))])
    return tuple(
        C3dEvent(60.0 * float(minutes) + float(seconds), *texts)
        for (minutes, seconds), texts in zip(pairs, zip(*columns, strict=False), strict=False)
    )


def _text(reader: Any, key: str) -> str:
    found = reader.get(key)
    return "" if found is None else str(found.string_value).strip().strip("\0")
