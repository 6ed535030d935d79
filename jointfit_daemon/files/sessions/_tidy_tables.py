"""A session as tidy tables for CSV and Parquet, with one row for each object and instant.

Units are part of the column names. Unknown values are NaN; the writers leave their cells empty.
Invariant: `session_of_tables` converts the tables of `tables_of` back to the same session.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import orjson

from jointfit_daemon.session_data import (
    FrameSeries,
    JointSeries,
    MarkerSeries,
    SegmentSeries,
    SensorSeries,
    SessionData,
    TimelineEvent,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

    Column = NDArray[Any]
    Table = dict[str, Column]

_Q = ("qw", "qx", "qy", "qz")
_INERTIAL = {
    "angular_velocity": tuple(f"angular_velocity_{axis}_rad_s" for axis in "xyz"),
    "acceleration": tuple(f"acceleration_{axis}_m_s2" for axis in "xyz"),
    "magnetic_field": tuple(f"magnetic_field_{axis}" for axis in "xyz"),
}
_XYZ = ("x_m", "y_m", "z_m")
TEXT_COLUMNS = frozenset(
    {"sensor", "segment", "marker", "source", "joint", "angle", "mode", "flags", "kind", "id",
     "text", "data", "key", "value"}
)  # fmt: skip
"""Names of the columns that contain text; all other columns contain numbers."""
TABLES: Mapping[str, tuple[str, ...]] = {
    "session": ("key", "value"),
    "sensors": (
        "t_s", "sensor", "segment", *_Q, *(name for names in _INERTIAL.values() for name in names)
    ),
    "markers": ("t_s", "marker", *_XYZ),
    "segments": ("t_s", "source", "segment", *_Q, "sd_deg"),
    "angles": ("t_s", "source", "joint", "angle", "angle_deg", "sd_deg"),
    "positions": ("t_s", "source", "joint", *_XYZ, "sd_m"),
    "frames": ("t_s", "mode", "flags"),
    "events": ("t_s", "kind", "id", "text", "data"),
}  # fmt: skip
"""Columns of every table. Only the table ``session`` is present in every session."""
_SOURCES = {"imu": "", "optical": "optical_"}
"""Prefix of the attributes ``segments`` and ``joints`` of a session, by source of the data."""
_NAME, _START, _DESCRIPTION = "name", "start_unix_ns", "description."


def tables_of(session: SessionData) -> dict[str, Table]:
    """Return the tables of a session by name; empty tables are omitted."""
    parts: dict[str, list[Table]] = {name: [] for name in TABLES}
    facts = {_NAME: session.name}
    if session.start_unix_ns is not None:
        facts[_START] = str(session.start_unix_ns)
    facts |= {_DESCRIPTION + key: value for key, value in session.description.items()}
    keys, values = (np.array([*column], object) for column in (facts.keys(), facts.values()))
    parts["session"] = [{"key": keys, "value": values}]
    parts["sensors"] = [_sensor_table(sensor) for sensor in session.sensors]
    if session.markers is not None:
        for k, label in enumerate(session.markers.labels):
            cells = _columns(_XYZ, session.markers.positions[:, k])
            parts["markers"].append(
                _fill_columns({"t_s": session.markers.t_s, "marker": label} | cells)
            )

    for source, prefix in _SOURCES.items():
        for segment in getattr(session, f"{prefix}segments"):
            head = {"t_s": segment.t_s, "source": source, "segment": segment.name}
            cells = _columns(_Q, segment.orientation) | {"sd_deg": _degrees(segment.sd_rad)}
            parts["segments"].append(_fill_columns(head | cells))
        for joint in getattr(session, f"{prefix}joints"):
            head = {"t_s": joint.t_s, "source": source, "joint": joint.name}
            for name, angle in joint.angles.items():
                sd_deg = _degrees(joint.angle_sd.get(name))
                cells = {"angle": name, "angle_deg": np.rad2deg(angle), "sd_deg": sd_deg}
                parts["angles"].append(_fill_columns(head | cells))
            if joint.position is not None:
                cells = _columns(_XYZ, joint.position) | {"sd_m": joint.position_sd}
                parts["positions"].append(_fill_columns(head | cells))
    parts["frames"] = _frame_tables(session.frames)
    if session.events:
        parts["events"].append(_event_table(session.events))
    return {
        name: {c: np.concatenate([table[c] for table in found]) for c in TABLES[name]}
        for name, found in parts.items()
        if found
    }


def _sensor_table(sensor: SensorSeries) -> Table:
    table = {"t_s": sensor.t_s, "sensor": sensor.id, "segment": sensor.segment}
    table |= _columns(_Q, sensor.orientation)
    for name, columns in _INERTIAL.items():
        table |= _columns(columns, getattr(sensor, name))
    return _fill_columns(table)


def _frame_tables(frames: FrameSeries | None) -> list[Table]:
    """Return the table of the frames; empty without frames."""
    if frames is None:
        return []
    modes, flags = np.array(frames.modes, object), np.array(frames.flags, object)
    return [{"t_s": frames.t_s, "mode": modes, "flags": flags}]


def _event_table(events: Sequence[TimelineEvent]) -> Table:
    return {
        "t_s": np.array([event.t_s for event in events], np.float64),
        "kind": np.array([event.kind for event in events], object),
        "id": np.array([event.id for event in events], object),
        "text": np.array([event.text for event in events], object),
        "data": np.array([orjson.dumps(dict(event.data)).decode() for event in events], object),
    }


def _columns(names: Sequence[str], values: Array | None) -> dict[str, Any]:
    if values is None:
        return dict.fromkeys(names)
    return {name: values[:, k] for k, name in enumerate(names)}


def _degrees(values: Array | None) -> Array | None:
    return None if values is None else np.rad2deg(values)


def _fill_columns(table: Mapping[str, Any]) -> Table:
    """Return all columns with full length. Texts are repeated, and missing columns are NaN."""
    count = len(table["t_s"])
    filled: Table = {}
    for name, column in table.items():
        if column is None:
            filled[name] = np.full(count, np.nan)
        elif isinstance(column, str):
            filled[name] = np.full(count, column, dtype=object)
        else:
            filled[name] = column
    return filled


def session_of_tables(tables: Mapping[str, Table], name: str) -> SessionData:
    """Return the session that the tables contain; `name` is used if they contain no name."""
    table = tables.get("session", {})
    facts = dict(zip(table.get("key", ()), table.get("value", ()), strict=True))
    series: dict[str, Any] = {
        "sensors": tuple(
            SensorSeries(
                item,
                str(rows["segment"][0]),
                rows["t_s"],
                _stack(rows, _Q),
                *(_known_values(_stack(rows, columns)) for columns in _INERTIAL.values()),
            )
            for (item,), rows in _groups(tables, "sensors", ("sensor",))
        )
    }
    for source, prefix in _SOURCES.items():
        series[f"{prefix}segments"] = tuple(
            SegmentSeries(
                item, rows["t_s"], _stack(rows, _Q), _known_values(np.deg2rad(rows["sd_deg"]))
            )
            for (found, item), rows in _groups(tables, "segments", ("source", "segment"))
            if found == source
        )
        series[f"{prefix}joints"] = tuple(_joints(tables, source))
    start, frames = facts.get(_START, ""), tables.get("frames")
    return SessionData(
        str(facts.get(_NAME, name)),
        int(start) if str(start).lstrip("-").isdecimal() else None,
        markers=_markers(tables),
        events=tuple(_events(tables.get("events", {}))),
        description={
            str(key).removeprefix(_DESCRIPTION): str(value)
            for key, value in facts.items()
            if str(key).startswith(_DESCRIPTION)
        },
        frames=None
        if frames is None
        else FrameSeries(frames["t_s"], tuple(frames["mode"]), tuple(frames["flags"])),
        **series,
    )


def _joints(tables: Mapping[str, Table], source: str) -> Iterable[JointSeries]:
    angles: dict[str, dict[str, Table]] = {}
    for (found, joint, angle), rows in _groups(tables, "angles", ("source", "joint", "angle")):
        if found == source:
            angles.setdefault(joint, {})[angle] = rows
    positions = {
        joint: rows
        for (found, joint), rows in _groups(tables, "positions", ("source", "joint"))
        if found == source
    }
    for joint in dict.fromkeys([*angles, *positions]):
        of_angles, place = angles.get(joint, {}), positions.get(joint)
        first = place if place is not None else next(iter(of_angles.values()))
        sds = {name: _known_values(np.deg2rad(rows["sd_deg"])) for name, rows in of_angles.items()}
        yield JointSeries(
            joint,
            first["t_s"],
            {name: np.deg2rad(rows["angle_deg"]) for name, rows in of_angles.items()},
            {name: sd for name, sd in sds.items() if sd is not None},
            None if place is None else _stack(place, _XYZ),
            None if place is None else _known_values(place["sd_m"]),
        )


def _markers(tables: Mapping[str, Table]) -> MarkerSeries | None:
    found = _groups(tables, "markers", ("marker",))
    if not found:
        return None
    # Tables of other programs may omit the rows of occluded markers.
    t_s = np.unique(np.concatenate([rows["t_s"] for _, rows in found]))
    positions = np.full((len(t_s), len(found), 3), np.nan)
    for k, (_, rows) in enumerate(found):
        positions[np.searchsorted(t_s, rows["t_s"]), k] = _stack(rows, _XYZ)
    return MarkerSeries(tuple(label for (label,), _ in found), t_s, positions)


def _events(table: Table) -> Iterable[TimelineEvent]:
    columns: Callable[[str], Any] = table.__getitem__
    if table:
        for t_s, kind, item, text, data in zip(*map(columns, TABLES["events"]), strict=True):
            yield TimelineEvent(float(t_s), kind, item, text, orjson.loads(data or "{}"))


def _groups(
    tables: Mapping[str, Table], name: str, keys: Sequence[str]
) -> list[tuple[tuple[str, ...], Table]]:
    """Return the rows of every object of a table, ordered by the first row of each object."""
    table = tables.get(name)
    if table is None or not len(table["t_s"]):
        return []
    names = list(zip(*(table[key] for key in keys), strict=True))
    codes = {found: k for k, found in enumerate(dict.fromkeys(names))}
    number = np.array([codes[found] for found in names])
    order = np.argsort(number, kind="stable")
    ends = np.cumsum(np.bincount(number))[:-1]
    rows = np.split(order, ends)
    return [
        (found, {column: values[rows[k]] for column, values in table.items()})
        for found, k in codes.items()
    ]


def _stack(rows: Table, names: Sequence[str]) -> Array:
    return np.column_stack([rows[name] for name in names])


def _known_values(values: Array) -> Array | None:
    """Return the values, or None if all values are unknown."""
    return None if np.isnan(values).all() else values
