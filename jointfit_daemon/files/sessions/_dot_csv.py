"""CSV files of Xsens / Movella DOT sensors, written by the app or the exporter: a file per sensor.

Lines ``NAME:,VALUE`` precede the column names. The reader uses ``DeviceTag``, ``OutputRate`` and
``SyncStatus``. ``SampleTimeFine`` is a 32-bit time of the row in units of 1 µs, so it wraps after
71.6 minutes. Angular rates are in degrees per second. The world is east, north, up; quaternions
convert from sensor to world. Output modes without angular rate and acceleration contain increments
``dq`` and ``dv`` for each row. An increment divided by its period is the mean rate. The format was
derived from the headers and columns of published files and from published programs. The project has
no DOT recording of its own for tests.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.files.sessions._xsens_columns import (
    axes_columns,
    orientation_columns,
    unwrap_counter,
)
from jointfit_daemon.files.text import (
    MalformedFileError,
    cells_of,
    read_columns,
    read_lines,
    require_times,
    separator_of,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.session_data import SensorSeries, SessionData

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from jointfit_daemon.arrays import Array

_TIME, _COUNTER = "SampleTimeFine", "PacketCounter"
_TURN = 1 << 32
_TICK_S = 1e-6
_HEADER_LINES = 40
"""Largest number of lines before the column names."""
_HZ = re.compile(r"([0-9.]+)\s*Hz", re.IGNORECASE)
_WORDS = ("Quat", "Euler", "FreeAcc", "Acc", "Gyr", "Mag", "dq", "dv", "Status")


class _DotFile(NamedTuple):
    """Data of one sensor, its time at the first row, and whether it was synchronized."""

    first_ticks: float
    synchronized: bool
    sensor: SensorSeries


def is_dot_csv(path: Path) -> bool:
    """Return whether a CSV file contains data of a DOT sensor."""
    with path.open("rb") as file:
        head = file.read(8192).decode("utf-8", "replace")
    return any(_is_names(line) for line in head.splitlines()[:_HEADER_LINES])


def read_dot_session(files: Sequence[Path], name: str) -> SessionData:
    """Return the sensors of one recording, from one CSV file for each sensor.

    Files of synchronized sensors have a common time, whose 0 s is the earliest row of all files.
    Without synchronization, every sensor begins at 0 s. The id of a sensor is its ``DeviceTag``. If
    a file has no tag, its name is the id. If an id occurs twice, the file names are the ids.

    Raises
    ------
    MalformedFileError
        A file has no column names, no times, or no signal.
    """
    read = [_read_sensor(path) for path in files]
    together = len(read) == 1 or all(one.synchronized for one in read)
    starts_s = np.zeros(len(read))
    if together:
        # The counter may wrap around between the starts of two sensors.
        ticks = np.array([one.first_ticks for one in read])
        ahead = np.mod(ticks - ticks[0] + _TURN / 2, _TURN) - _TURN / 2
        starts_s = (ahead - ahead.min()) * _TICK_S

    tags = [one.sensor.id for one in read]
    names = tags if len(set(tags)) == len(tags) else [path.stem for path in files]
    description = {"files": ", ".join(path.name for path in files)}
    if not together:
        description["synchronization"] = (
            "SyncStatus of the files is not Synced: every sensor begins at 0 s"
        )
    return SessionData(
        name,
        sensors=tuple(
            replace(one.sensor, id=sensor_id, t_s=one.sensor.t_s + start_s)
            for one, sensor_id, start_s in zip(read, names, starts_s, strict=True)
        ),
        description=description,
    )


def _is_names(line: str) -> bool:
    """Return whether a line contains column names."""
    cells = cells_of(line, separator_of(line))
    return _TIME in cells and any(cell.startswith(_WORDS) for cell in cells)


def _read_sensor(path: Path) -> _DotFile:
    lines = read_lines(path)
    at = next((k for k, line in enumerate(lines[:_HEADER_LINES]) if _is_names(line)), None)
    if at is None:
        raise MalformedFileError(
            f"{path}: no column {_TIME} in the first {_HEADER_LINES} lines: export the recording of"
            " the DOT sensor again, with its sample time"
        )
    header = {}  # values before the column names, by lower-case name
    for line in lines[:at]:
        name, mark, value = line.partition(":")
        if mark:
            header[name.strip().lower()] = value.strip(" ,;\t")
    names, columns = read_columns(path, lines, at)

    ticks = columns[_TIME]
    if not np.isfinite(ticks).all():
        raise MalformedFileError(
            f"{path}: rows without {_TIME}: export the recording again, with this value in all rows"
        )
    t_s = unwrap_counter(ticks, _TURN) * _TICK_S
    require_times(path, t_s)

    orientation = orientation_columns(columns, len(t_s))
    rate, force = _rate_and_force(columns, _period_s(header, t_s))
    magnetic = axes_columns(columns, "Mag_{}")
    if np.isnan(orientation).all() and rate is force is magnetic is None:
        raise MalformedFileError(
            f"{path}: found the columns {', '.join(names[:8])}, expected an orientation (Quat or"
            " Euler), Gyr, Acc, dq and dv, or Mag: record in another measurement mode"
        )
    tag = header.get("devicetag") or path.stem
    sensor = SensorSeries(tag, "", t_s, orientation, rate, force, magnetic)
    first = float(ticks[0]) if len(ticks) else 0.0
    return _DotFile(first, header.get("syncstatus", "").lower() == "synced", sensor)


def _period_s(header: Mapping[str, str], t_s: Array) -> float:
    """Return the period over which an increment was measured, s; lost rows do not change it."""
    hz = _HZ.search(header.get("outputrate", ""))
    try:
        rate_hz = float(hz[1]) if hz else 0.0
    except ValueError:
        rate_hz = 0.0
    if rate_hz > 0.0:
        return 1.0 / rate_hz
    return float(np.median(np.diff(t_s))) if len(t_s) > 1 else np.nan


def _rate_and_force(
    columns: Mapping[str, Array], period_s: float
) -> tuple[Array | None, Array | None]:
    """Return angular velocity, rad/s, and specific force, m/s², both in sensor axes."""
    rate = axes_columns(columns, "Gyr_{}")
    if rate is not None:
        rate = np.deg2rad(rate)
    elif all(f"dq_{axis}" in columns for axis in "WXYZ"):
        turns = np.column_stack([columns[f"dq_{axis}"] for axis in "WXYZ"])
        rate = rotation.log(rotation.normalize(turns)) / period_s

    # FreeAcc is in world axes and excludes gravity, so it is not a specific force.
    force = axes_columns(columns, "Acc_{}")
    if force is None and all(f"dv[{k}]" in columns for k in (1, 2, 3)):
        force = np.column_stack([columns[f"dv[{k}]"] for k in (1, 2, 3)]) / period_s
    return rate, force
