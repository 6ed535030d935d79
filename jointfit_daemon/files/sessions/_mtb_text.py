"""Text files that Xsens programs (MT Manager, MTw) export, one file per sensor.

Lines that begin with ``//`` are comments; only ``// Update Rate: 100.0Hz`` is used. The next lines
contain column names and rows, separated by tabs. The rows are numbered by the packet counter (16
bit) or the sample time (32 bit, 0.1 ms), so lost packets appear as gaps in time.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.sessions._xsens_columns import (
    axes_columns,
    orientation_columns,
    unwrap_counter,
)
from jointfit_daemon.files.text import (
    MalformedFileError,
    read_columns,
    read_lines,
    require_times,
)
from jointfit_daemon.session_data import SensorSeries, SessionData

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from jointfit_daemon.arrays import Array

_RATE = re.compile(r"Update Rate:\s*([0-9.]+)\s*Hz", re.IGNORECASE)
_COUNTER, _SAMPLE_TIME = "PacketCounter", "SampleTimeFine"
_COUNTER_TURN, _SAMPLE_TIME_TURN = 1 << 16, 1 << 32
_TICK_S = 1e-4
_SERIAL = re.compile(r"([0-9A-F]{8})$", re.IGNORECASE)


def is_mtb_text(path: Path) -> bool:
    """Return whether a text file begins in the same way as the exports of Xsens programs."""
    with path.open("rb") as file:
        head = file.read(4096)
    return head.startswith(b"//") or b"PacketCounter" in head.split(b"\n")[0]


def read_mtb_session(files: Sequence[Path], name: str) -> SessionData:
    """Return the sensors of one recording, from one exported text file for each sensor.

    The counters of all sensors have a common start, so 0 s is the earliest row of all files. The id
    of a sensor is the serial number at the end of the file name, or else the whole name.

    Raises
    ------
    MalformedFileError
        A file has no column names, no times, or no signal.
    """
    read = [(path, *_read_sensor(path)) for path in files]
    first_s = min(start_s for _, start_s, _ in read)
    return SessionData(
        name,
        sensors=tuple(
            replace(sensor, t_s=sensor.t_s + (start_s - first_s)) for _, start_s, sensor in read
        ),
        description={"files": ", ".join(path.name for path in files)},
    )


def _read_sensor(path: Path) -> tuple[float, SensorSeries]:
    """Return the counter's time at the first row, s, and the sensor with times from 0 s."""
    lines = read_lines(path)
    at = next((k for k, line in enumerate(lines) if not line.startswith("//")), None)
    if at is None or (_COUNTER not in lines[at] and _SAMPLE_TIME not in lines[at]):
        raise MalformedFileError(
            f"{path}: no column {_COUNTER} or {_SAMPLE_TIME} after the lines of comments: export"
            " the recording again, with one of these columns"
        )
    names, columns = read_columns(path, lines, at)

    rate = _RATE.search("\n".join(lines[:at]))
    start_s, t_s = _times(path, columns, None if rate is None else float(rate[1]))
    require_times(path, t_s)
    orientation = orientation_columns(columns, len(t_s))
    signals = [axes_columns(columns, f"{word}_{{}}") for word in ("Gyr", "Acc", "Mag")]
    if np.isnan(orientation).all() and all(signal is None for signal in signals):
        raise MalformedFileError(
            f"{path}: found the columns {', '.join(names[:8])}, expected an orientation (Quat, Mat"
            " or Roll, Pitch, Yaw), Gyr, Acc or Mag: export them"
        )
    serial = _SERIAL.search(path.stem)
    return start_s, SensorSeries(serial[1] if serial else path.stem, "", t_s, orientation, *signals)


def _times(path: Path, columns: Mapping[str, Array], rate_hz: float | None) -> tuple[float, Array]:
    """Return the counter's time at the first row, s, and the time of every row since then, s."""
    ticks = columns.get(_SAMPLE_TIME)
    if ticks is not None and len(ticks) and np.isfinite(ticks).all():
        return float(ticks[0]) * _TICK_S, unwrap_counter(ticks, _SAMPLE_TIME_TURN) * _TICK_S
    counter = columns.get(_COUNTER)
    if counter is None or rate_hz is None or not rate_hz > 0.0:
        raise MalformedFileError(
            f"{path}: no {_SAMPLE_TIME} and no '// Update Rate', so the rows have no times: export"
            " the recording again, with its header"
        )
    first = float(counter[0]) / rate_hz if len(counter) else 0.0
    return first, unwrap_counter(counter, _COUNTER_TURN) / rate_hz
