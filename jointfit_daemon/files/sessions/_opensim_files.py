"""Orientations and joint angles of a session as OpenSim files: STO and MOT.

STO files contain the orientations q_world_body with z up, as OpenSense expects for sensors. The
set-up files of OpenSense rotate them by ``sensor_to_opensim_rotations`` = -pi/2 0 0. An unknown
orientation is NaN, which OpenSense ignores. Positions in MOT files have the axes of OpenSim, y up.
A MOT file has no unknown values, because OpenSim's class `Storage` misreads NaN. Frames and columns
with unknown values are therefore omitted.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.files.axes import from_z_up, to_z_up
from jointfit_daemon.files.orientations import (
    OrientationTable,
    TimeTable,
    read_orientations_sto,
    read_sto,
    write_known_values,
    write_orientations_sto,
)
from jointfit_daemon.files.sessions._header import header_facts, header_line, start_of
from jointfit_daemon.files.sessions._uniform_axis import UniformAxis
from jointfit_daemon.files.sessions._written_session import NothingToWriteError, WrittenSession
from jointfit_daemon.files.text import read_lines
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.session_data import JointSeries, SegmentSeries, SensorSeries, SessionData

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from jointfit_daemon.arrays import Array

_POSITION_PARTS = (("_x", "_y", "_z"), ("_tx", "_ty", "_tz"))
"""Endings of the names of position columns: of this project, and of OpenSim's coordinates."""
_TRANSLATION = re.compile(r"_t?[xyz]$")
_LATE_START_S = 1.0
"""Largest difference between the starts of the series of a group, s, at which the frames before the
last start are omitted."""
_SAME_INSTANT_S = 1e-6
_GROUPS = ("sensors", "segments", "optical_segments")


def write_sto_session(
    session: SessionData, folder: Path, names: Mapping[str, str] | None = None
) -> WrittenSession:
    """Write ``NAME_sensors.sto``, ``NAME_segments.sto`` and ``NAME_optical_segments.sto``.

    Parameters
    ----------
    session, folder
        Session to write, and existing folder for the files. A group without series gets no file. If
        all series of a group start within 1 s, frames before the last start are omitted.
    names
        Column names of sensors and segments, for example ``{"S1": "femur_r_imu"}``. OpenSense finds
        the body of a column by the column's name.
    """
    files: list[Path] = []
    notes: list[str] = []
    for group in _GROUPS:
        series = _orientations_of(session, group)
        if not series:
            continue
        axis = UniformAxis([t_s for _, t_s, _ in series])
        columns = [axis.orientations(name, t_s, q) for name, t_s, q in series]
        header = header_line(
            group=group,
            start_unix_ns=session.start_unix_ns,
            resampled=axis.resampled or None,
            segments={(names or {}).get(s.id, s.id): s.segment for s in session.sensors}
            if group == "sensors"
            else None,
        )
        quaternions = np.stack(columns, axis=1)
        # Sensors rarely start at the same instant, but OpenSim's tool IMUPlacer needs all of them
        # in the first frame.
        starts = [t_s[0] for _, t_s, _ in series]
        late_s = max(starts) if max(starts) - min(starts) <= _LATE_START_S else min(starts)
        rows = ~np.isnan(quaternions).all(axis=(1, 2))
        rows &= axis.t_s >= late_s - _SAME_INSTANT_S
        if not rows.any():
            continue
        path = folder / f"{session.name}_{group}.sto"
        labels = tuple((names or {}).get(name, name) for name, _, _ in series)
        table = OrientationTable(labels, axis.t_s[rows], quaternions[rows], axis.rate_hz, header)
        write_orientations_sto(path, table)
        files.append(path)
        notes += axis.note(path.name)
        if np.isnan(table.quaternions[0]).any():
            notes.append(f"{path.name}: the first frame lacks orientations that IMUPlacer needs")
    return _session_summary(session, "orientations for a STO file", files, notes)


def read_sto_session(path: Path) -> SessionData:
    """Return the orientations of a STO file.

    Orientations in files of other programs become sensors with the names of the columns. Tables
    without orientations are read by `read_mot_session`.
    """
    if not any(line.lower().startswith("datatype=quaternion") for line in read_lines(path)[:40]):
        return read_mot_session(path)
    table = read_orientations_sto(path)
    facts = header_facts(table.header)
    quaternions = rotation.normalize(table.quaternions)
    columns = [(name, quaternions[:, k]) for k, name in enumerate(table.names)]
    group, segments = facts.get("group"), facts.get("segments")
    if group in ("segments", "optical_segments"):
        series = tuple(SegmentSeries(name, table.t_s, q) for name, q in columns)
        own, optical = (series, ()) if group == "segments" else ((), series)
        return SessionData(path.stem, start_of(facts), segments=own, optical_segments=optical)

    carried_by = segments if isinstance(segments, dict) else {}
    sensors = tuple(
        SensorSeries(name, str(carried_by.get(name, "")), table.t_s, q) for name, q in columns
    )
    return SessionData(path.stem, start_of(facts), sensors=sensors)


def write_mot_session(session: SessionData, folder: Path) -> WrittenSession:
    """Write ``NAME.mot`` and, from the markers, ``NAME_optical.mot``: joint angles and positions.

    The columns are ``JOINT_ANGLE`` and ``JOINT_ANGLE_sd`` in degrees, and ``JOINT_x``, ``JOINT_y``,
    ``JOINT_z`` and ``JOINT_position_sd`` in m.
    """
    files: list[Path] = []
    notes: list[str] = []
    for ending, joints in (("", session.joints), ("_optical", session.optical_joints)):
        if not joints:
            continue
        axis = UniformAxis([joint.t_s for joint in joints])
        columns: dict[str, Array] = {}
        for joint in joints:
            columns |= _joint_columns(joint, axis)
        if not columns:
            continue
        header = header_line(
            group="optical_joints" if ending else "joints",
            start_unix_ns=session.start_unix_ns,
            resampled=axis.resampled or None,
            joints={joint.name: sorted(joint.angles) for joint in joints},
        )
        path = folder / f"{session.name}{ending}.mot"
        values = np.column_stack(list(columns.values()))
        table = TimeTable(
            tuple(columns), axis.t_s, values, in_degrees=True, name=path.stem, header=header
        )
        written = write_known_values(path, table)
        if written.frames:
            files.append(written.path)
        notes += [*written.notes, *axis.note(path.name)]
    return _session_summary(session, "joints for a MOT file", files, notes)


def read_mot_session(path: Path) -> SessionData:
    """Return the joints of a MOT or STO file with one number in each cell.

    In files of other programs, every column becomes a joint with one angle, called ``angle``. The
    exceptions are position columns, in m with y up: ``NAME_tx``, ``NAME_ty`` and ``NAME_tz``, or
    ``NAME_x``, ``NAME_y`` and ``NAME_z``. Three such columns become the positions of a joint.
    """
    table = read_sto(path)
    facts = header_facts(table.header)
    values = {name: table.values[:, k] for k, name in enumerate(table.columns)}
    if table.in_degrees:
        for name, column in values.items():
            if not (_TRANSLATION.search(name) or name.endswith("_position_sd")):  # a length
                values[name] = np.deg2rad(column)
    declared = facts.get("joints")
    found = tuple(
        _declared_joints(table.t_s, values, declared)
        if isinstance(declared, dict)
        else _foreign_joints(table.t_s, values)
    )
    own, optical = ((), found) if facts.get("group") == "optical_joints" else (found, ())
    return SessionData(path.stem, start_of(facts), joints=own, optical_joints=optical)


def _orientations_of(session: SessionData, group: str) -> list[tuple[str, Array, Array]]:
    if group == "sensors":
        return [(s.id, s.t_s, s.orientation) for s in session.sensors if len(s.t_s)]
    found: Sequence[SegmentSeries] = getattr(session, group)
    return [(s.name, s.t_s, s.orientation) for s in found if len(s.t_s)]


def _joint_columns(joint: JointSeries, axis: UniformAxis) -> dict[str, Array]:
    columns: dict[str, Array] = {}
    for name, angle in joint.angles.items():
        columns[f"{joint.name}_{name}"] = np.rad2deg(axis.values(joint.name, joint.t_s, angle))
        if name in joint.angle_sd:
            sd = axis.values(joint.name, joint.t_s, joint.angle_sd[name])
            columns[f"{joint.name}_{name}_sd"] = np.rad2deg(sd)
    if joint.position is not None:
        position = from_z_up(axis.values(joint.name, joint.t_s, joint.position), "y")
        columns |= {f"{joint.name}_{part}": position[:, k] for k, part in enumerate("xyz")}
    if joint.position_sd is not None:
        sd = axis.values(joint.name, joint.t_s, joint.position_sd)
        columns[f"{joint.name}_position_sd"] = sd
    return columns


def _declared_joints(
    t_s: Array, values: Mapping[str, Array], declared: Mapping[str, Any]
) -> Iterable[JointSeries]:
    for joint, angles in declared.items():
        names = [name for name in angles if f"{joint}_{name}" in values]
        yield JointSeries(
            joint,
            t_s,
            {name: values[f"{joint}_{name}"] for name in names},
            {name: values[sd] for name in names if (sd := f"{joint}_{name}_sd") in values},
            _position(values, joint, _POSITION_PARTS[0]),
            values.get(f"{joint}_position_sd"),
        )


def _foreign_joints(t_s: Array, values: Mapping[str, Array]) -> Iterable[JointSeries]:
    used: set[str] = set()
    for name in values:
        for parts in _POSITION_PARTS:
            joint = name.removesuffix(parts[0])
            position = _position(values, joint, parts) if joint != name else None
            if position is not None:
                used |= {joint + part for part in parts}
                yield JointSeries(joint, t_s, position=position)
    for name, column in values.items():
        if name not in used:
            yield JointSeries(name, t_s, {"angle": column})


def _position(values: Mapping[str, Array], joint: str, parts: Sequence[str]) -> Array | None:
    columns = [values.get(joint + part) for part in parts]
    known = [column for column in columns if column is not None]
    return to_z_up(np.column_stack(known), "y") if len(known) == len(parts) else None


def _session_summary(
    session: SessionData, contents: str, files: Sequence[Path], notes: Sequence[str]
) -> WrittenSession:
    if not files:
        reason = f": {notes[0]}" if notes else ""
        raise NothingToWriteError(
            f"session {session.name!r} has no {contents}{reason}: choose another format, for"
            " example csv"
        )
    return WrittenSession(tuple(files), tuple(notes))
