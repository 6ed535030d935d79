"""Markers of a session as TRC and C3D files.

TRC files have the axes of OpenSim (y up). C3D files have the axes of the project (z up) and declare
them. Both formats have a uniform frame rate: missing rows become frames without markers.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.axes import from_z_up
from jointfit_daemon.files.mocap import (
    MOST_ITEMS,
    C3dEvent,
    MarkerTrajectories,
    c3d_bytes,
    read_c3d,
    read_marker_trial,
    write_trc,
)
from jointfit_daemon.files.sessions._uniform_axis import UniformAxis
from jointfit_daemon.files.sessions._written_session import NothingToWriteError, WrittenSession
from jointfit_daemon.session_data import MarkerSeries, SessionData, TimelineEvent

if TYPE_CHECKING:
    from pathlib import Path

_LATEST_FRAME = 0xFFFF
"""Largest number of a first frame that fits into the header of a C3D file."""
_START, _FIRST, _RATE = "START_UNIX_NS", "FIRST_S", "RATE_HZ"


def write_trc_session(session: SessionData, folder: Path) -> WrittenSession:
    """Write ``NAME.trc``: marker positions in m, y up; occluded markers are empty cells."""
    markers = _markers_of(session, "TRC")
    axis = UniformAxis([markers.t_s])
    positions = from_z_up(axis.values("markers", markers.t_s, markers.positions), "y")
    numbers = np.arange(1, len(axis.t_s) + 1, dtype=np.int64)

    path = folder / f"{session.name}.trc"
    write_trc(path, MarkerTrajectories(markers.labels, axis.t_s, numbers, positions, axis.rate_hz))
    return WrittenSession((path,), tuple(axis.note(path.name)))


def read_trc_session(path: Path) -> SessionData:
    """Return the markers of a TRC file, assuming the axes of OpenSim (y up)."""
    return SessionData(path.stem, markers=_read_markers(path))


def write_c3d_session(session: SessionData, folder: Path) -> WrittenSession:
    """Write ``NAME.c3d``: events, and marker positions in mm, z up, residual -1 where occluded."""
    markers = _markers_of(session, "C3D")
    axis = UniformAxis([markers.t_s])
    positions = axis.values("markers", markers.t_s, markers.positions)
    path = folder / f"{session.name}.c3d"
    notes = axis.note(path.name)

    # Frame 1 is at 0 s. A frame number stands for a whole number of periods, so a parameter of the
    # group JOINTFIT stores the exact time of the first frame.
    first_s = float(axis.t_s[0]) if len(axis.t_s) else 0.0
    first_frame = round(first_s * axis.rate_hz) + 1
    if not 1 <= first_frame <= _LATEST_FRAME:
        first_frame = 1
    offset_s = first_s - (first_frame - 1) / axis.rate_hz
    events = [
        C3dEvent(event.t_s - offset_s, event.kind, event.id, event.text) for event in session.events
    ]
    if len(events) > MOST_ITEMS:
        notes.append(
            f"{path.name}: {MOST_ITEMS} of {len(events)} events written, the most that C3D permits"
        )

    texts = {_FIRST: repr(first_s), _RATE: repr(axis.rate_hz)}
    if session.start_unix_ns is not None:
        texts[_START] = str(session.start_unix_ns)
    data = c3d_bytes(
        markers.labels,
        positions,
        rate_hz=axis.rate_hz,
        up="+Z",
        first_frame=first_frame,
        events=events[:MOST_ITEMS],
        own_texts=texts,
    )
    path.write_bytes(data)
    return WrittenSession((path,), tuple(notes))


def read_c3d_session(path: Path) -> SessionData:
    """Return markers and events of a C3D file."""
    markers, trial = _read_markers(path), read_c3d(path)
    texts = trial.own_texts
    try:
        start = int(texts[_START]) if texts.get(_START) else None
        first_s, rate_hz = float(texts.get(_FIRST, "nan")), float(texts.get(_RATE, "nan"))
    except ValueError:
        start, first_s, rate_hz = None, math.nan, math.nan

    offset_s = 0.0
    if math.isfinite(first_s) and rate_hz > 0.0:
        offset_s = first_s - (int(trial.trajectories.frames[0]) - 1) / rate_hz
        t_s = first_s + np.arange(len(markers.t_s)) / rate_hz
        markers = MarkerSeries(markers.labels, t_s, markers.positions)
    events = [
        TimelineEvent(event.t_s + offset_s, event.label or "event", event.context, event.text)
        for event in trial.events
        if math.isfinite(event.t_s)
    ]
    return SessionData(
        path.stem, start, markers=markers, events=tuple(sorted(events, key=lambda e: e.t_s))
    )


def _markers_of(session: SessionData, kind: str) -> MarkerSeries:
    if session.markers is None or not session.markers.labels or not len(session.markers.t_s):
        raise NothingToWriteError(
            f"session {session.name!r} has no markers, so no {kind} file can be written: choose"
            " another format, for example csv"
        )
    return session.markers


def _read_markers(path: Path) -> MarkerSeries:
    found = read_marker_trial(path).trajectories
    labels = tuple(name or f"unnamed_{k}" for k, name in enumerate(found.names, start=1))
    return MarkerSeries(labels, found.t_s, found.positions)
