"""Sessions as data sets of Motion-BIDS, the Brain Imaging Data Structure for motion.

A data set is a folder with one subject. Each tracking system has the files ``_motion.tsv`` (numbers
without column names), ``_channels.tsv``, ``_motion.json`` and ``_channels.json``; events have a
file of their own. The series of one kind, for example all segments, form one tracking system if
they have the same times. Otherwise each series is a separate tracking system. The first channel
(LATENCY) is the time since the start of the session. Joint angles are in degrees, orientations are
quaternions, and unknown values are ``n/a``. Source: Brain Imaging Data Structure 1.10, "Motion";
Jeung et al. 2024, doi 10.1038/s41597-024-03559-8.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from math import isnan
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import orjson

import jointfit_daemon
from jointfit_daemon.files.sessions._channel_streams import (
    ANGLE,
    ANGLE_SD,
    GROUPS,
    ORIENTATION,
    POSITION,
    UNITS,
    ChannelStream,
    StreamColumn,
    merge_streams,
    session_of,
    streams_of,
)
from jointfit_daemon.files.sessions._header import start_of
from jointfit_daemon.files.sessions._written_session import WrittenSession
from jointfit_daemon.files.text import MalformedFileError, number, read_json, read_lines
from jointfit_daemon.session_data import TimelineEvent, sample_rate_hz

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from jointfit_daemon.files.sessions._channel_streams import Group
    from jointfit_daemon.session_data import SessionData

BIDS_VERSION = "1.10.0"
_SUBJECT = "sub-01"
_MISSING = "n/a"
_TYPES = {
    ORIENTATION: "ORNT",
    "angular_velocity": "GYRO",
    "acceleration": "ACCEL",
    "magnetic_field": "MAGN",
    POSITION: "POS",
    ANGLE: "JNTANG",
}
"""Channel type of each quantity; standard deviations have the type MISC."""
_DEGREES = frozenset({ANGLE, ANGLE_SD})
_CHANNEL_COLUMNS = (
    "name", "component", "type", "tracked_point", "units", "placement", "reference_frame",
    "description",
)  # fmt: skip
_EVENT_COLUMNS = ("onset", "duration", "trial_type", "id", "text", "data")
_FRAMES: dict[Group, str] = {
    "sensors": "global",
    "segments": "global",
    "joints": "global",
    "markers": "optical",
    "optical_segments": "optical",
    "optical_joints": "optical",
}
_SYSTEMS: dict[Group, str] = {
    "sensors": "inertial sensors",
    "markers": "optical markers",
    "segments": "segments, estimated from inertial sensors",
    "joints": "joints, estimated from inertial sensors",
    "optical_segments": "segments, from optical markers",
    "optical_joints": "joints, from optical markers",
}
_AXES = {
    "SpatialAxes": "RAS",
    "RotationRule": "right-hand",
    "RotationOrder": _MISSING,
}
_LEVELS = {
    "global": {
        "Description": "World: x east, y north, z up; without magnetometer the heading is"
        " arbitrary.",
        **_AXES,
    },
    "optical": {
        "Description": "World of the motion-capture system, z up; the heading is arbitrary.",
        **_AXES,
    },
    "local": {"Description": "Axes of the sensor as printed on its housing.", **_AXES},
}


def write_bids_session(session: SessionData, folder: Path) -> WrittenSession:
    """Write the data set into the new folder ``NAME_bids``."""
    root = folder / f"{session.name}_bids"
    motion = root / _SUBJECT / "motion"
    motion.mkdir(parents=True)
    stem = f"{_SUBJECT}_task-{_label(session.name)}"

    description = {
        "Name": session.name,
        "BIDSVersion": BIDS_VERSION,
        "DatasetType": "raw",
        "GeneratedBy": [{"Name": "jointfitd", "Version": jointfit_daemon.__version__}],
        "JointfitDescription": dict(session.description),
    }
    _write_json(root / "dataset_description.json", description)
    facts = "".join(f"- {key}: {value}\n" for key, value in session.description.items())
    text = (
        f"# {session.name}\n\nWritten by jointfitd {jointfit_daemon.__version__}. Series of one"
        " kind with common times form one tracking system. The channel latency is the time since"
        f" the start of the session.\n\n{facts}"
    )
    (root / "README.md").write_text(text, encoding="utf-8")
    (root / "participants.tsv").write_text(f"participant_id\n{_SUBJECT}\n", encoding="utf-8")

    acquired = _MISSING
    if session.start_unix_ns is not None:
        start = datetime.fromtimestamp(session.start_unix_ns / 1e9, UTC)
        acquired = start.strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    scans = []
    labels: set[str] = set()
    for stream in merge_streams(streams_of(session)):
        label = _free_label(stream, labels)
        base = f"{stem}_tracksys-{label}"
        _write_motion(motion / f"{base}_motion.tsv", stream)
        _write_channels(motion / f"{base}_channels.tsv", stream)
        levels = {name: _LEVELS[name] for name in sorted({_FRAMES[stream.group], "local"})}
        _write_json(
            motion / f"{base}_channels.json",
            {"reference_frame": {"Description": "Frame of the channel.", "Levels": levels}},
        )
        _write_json(motion / f"{base}_motion.json", _sidecar(session, stream))
        scans.append(f"motion/{base}_motion.tsv\t{acquired}")

    if session.events:
        _write_events(motion, stem, session.events)
    table = "\n".join(["filename\tacq_time", *scans])
    (root / _SUBJECT / f"{_SUBJECT}_scans.tsv").write_text(f"{table}\n", encoding="utf-8")
    return WrittenSession(tuple(sorted(path for path in root.rglob("*") if path.is_file())))


def _label(name: str) -> str:
    """Return a name as a BIDS label, which contains letters and digits only."""
    return re.sub(r"[^0-9A-Za-z]", "", name) or "session"


def _free_label(stream: ChannelStream, taken: set[str]) -> str:
    words = [stream.group] if stream.name == stream.group else [stream.group, stream.name]
    base = "".join(_label(word) for word in re.split(r"_", "_".join(words)) if word) or "stream"
    label, count = base, 1
    while label.lower() in taken:
        count += 1
        label = f"{base}x{count}"
    taken.add(label.lower())
    return label


def _write_motion(path: Path, stream: ChannelStream) -> None:
    scale = [_scale(channel) for channel in stream.channels]
    values = stream.values * np.array(scale) if scale else stream.values
    with path.open("w", encoding="utf-8") as file:
        for t_s, row in zip(stream.t_s.tolist(), values.tolist(), strict=True):
            cells = (_MISSING if isnan(value) else f"{value:.9g}" for value in row)
            file.write("\t".join((f"{t_s:.9f}", *cells)) + "\n")


def _scale(channel: StreamColumn) -> float:
    return float(np.rad2deg(1.0)) if channel.quantity in _DEGREES else 1.0


def _write_channels(path: Path, stream: ChannelStream) -> None:
    latency = ("latency", _MISSING, "LATENCY", _MISSING, "s", _MISSING, _MISSING, "session time")
    rows = [_CHANNEL_COLUMNS, latency]
    for channel in stream.channels:
        local = channel.quantity in ("angular_velocity", "acceleration", "magnetic_field")
        component = channel.component
        if channel.quantity == ORIENTATION:
            component = f"quat_{component}"
        elif component not in ("x", "y", "z"):
            component = _MISSING
        frame = "local" if local else _FRAMES[stream.group]
        rows.append(
            (
                channel.label,
                component,
                _TYPES.get(channel.quantity, "MISC"),
                channel.object,
                "deg" if channel.quantity in _DEGREES else channel.unit or _MISSING,
                channel.placement or _MISSING,
                _MISSING if channel.quantity.startswith(ANGLE) else frame,
                f"{channel.quantity} {channel.component}".strip(),
            )
        )
    text = "".join("\t".join(row) + "\n" for row in rows)
    path.write_text(text, encoding="utf-8")


def _sidecar(session: SessionData, stream: ChannelStream) -> dict[str, Any]:
    rate_hz = sample_rate_hz(stream.t_s)
    known = bool(np.isfinite(rate_hz))
    types = [_TYPES.get(channel.quantity, "MISC") for channel in stream.channels]
    counts = {f"{kind}ChannelCount": types.count(kind) for kind in _TYPES.values()}
    span_s = float(stream.t_s[-1] - stream.t_s[0]) if known else 0.0
    return {
        "TaskName": session.name,
        "SamplingFrequency": round(rate_hz, 6) if known else 0,
        "SamplingFrequencyEffective": (len(stream.t_s) - 1) / span_s if known else _MISSING,
        "TrackingSystemName": _SYSTEMS[stream.group],
        "MissingValues": _MISSING,
        "MotionChannelCount": 1 + len(types),
        "LATENCYChannelCount": 1,
        **counts,
        "MiscChannelCount": types.count("MISC"),
        "TrackedPointsCount": len({channel.object for channel in stream.channels}),
        "SoftwareVersions": f"jointfitd {jointfit_daemon.__version__}",
        "JointfitGroup": stream.group,
        "JointfitName": stream.name,
        "JointfitStartUnixNs": session.start_unix_ns,
    }


def _write_events(folder: Path, stem: str, events: Sequence[TimelineEvent]) -> None:
    rows = ["\t".join(_EVENT_COLUMNS)]
    for event in events:
        data = orjson.dumps(dict(event.data)).decode()
        text = " ".join(event.text.split())  # written on one line
        texts = (event.kind, event.id or _MISSING, text or _MISSING, data)
        rows.append("\t".join((f"{event.t_s:.9f}", "0", *texts)))
    (folder / f"{stem}_events.tsv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    _write_json(
        folder / f"{stem}_events.json",
        {
            "trial_type": {"Description": "Kind of event."},
            "id": {"Description": "Sensor, segment or phase concerned."},
            "text": {"Description": "Text of the event."},
            "data": {"Description": "Further values, a JSON object."},
        },
    )


def _write_json(path: Path, content: Any) -> None:
    path.write_bytes(orjson.dumps(content, option=orjson.OPT_INDENT_2) + b"\n")


def read_bids_session(root: Path) -> SessionData:
    """Return the session of a Motion-BIDS data set with one subject and task.

    In a data set that another program wrote, tracking systems with positions become markers, and
    tracking systems with quaternions become sensors.

    Raises
    ------
    MalformedFileError
        The folder is no data set with motion, contains several subjects or tasks, or a file is
        wrong.
    FileNotFoundError
        The description of the channels of a tracking system is missing.
    """
    files = sorted(root.glob("sub-*/**/motion/*_motion.tsv"))
    recordings = {path.name.split("_tracksys-")[0] for path in files}
    if len(recordings) != 1:
        found = ", ".join(sorted(recordings)[:4]) or "no file _motion.tsv"
        raise MalformedFileError(
            f"{root}: found {found}, expected a data set with one subject and one task: copy one"
            " subject and task into a separate folder"
        )
    streams, starts, name = [], [], root.name.removesuffix("_bids")
    for path in files:
        facts = _json_object(path.with_suffix(".json"))
        stream = _read_stream(path, facts)
        if stream is not None:
            streams.append(stream)
        starts.append(start_of({"start_unix_ns": facts.get("JointfitStartUnixNs")}))
    description = _json_object(root / "dataset_description.json").get("JointfitDescription")
    return session_of(
        streams,
        name,
        start_unix_ns=next((start for start in starts if start is not None), None),
        events=sorted(_read_events(files[0]), key=lambda event: event.t_s),
        description=description if isinstance(description, dict) else {},
    )


def _json_object(path: Path) -> dict[str, Any]:
    found = read_json(path) if path.exists() else {}
    return found if isinstance(found, dict) else {}


def _read_stream(path: Path, facts: Mapping[str, Any]) -> ChannelStream | None:
    channels_path = path.with_name(path.name.removesuffix("_motion.tsv") + "_channels.tsv")
    rows = [line.split("\t") for line in read_lines(channels_path)]
    head = rows[0] if rows else []
    if not {"name", "component", "type", "tracked_point"} <= set(head):
        raise MalformedFileError(
            f"{channels_path}: found the columns {', '.join(head)[:80]}, expected name, component,"
            " type, tracked_point: correct the file"
        )
    described = [dict(zip(head, row, strict=False)) for row in rows[1:]]
    table = _read_motion(path, len(described))

    types = [row.get("type", "").upper() for row in described]
    columns: dict[StreamColumn, int] = {}
    for k, row in enumerate(described):
        channel = _channel_of(row)
        if channel is not None:
            columns.setdefault(channel, k)
    if not columns:
        return None
    rate = facts.get("SamplingFrequency")
    if "LATENCY" in types:
        t_s = table[:, types.index("LATENCY")]
    elif isinstance(rate, int | float) and rate > 0:
        t_s = np.arange(len(table)) / rate
    else:
        raise MalformedFileError(
            f"{path}: no channel LATENCY and no SamplingFrequency: add SamplingFrequency to the"
            f" file {path.with_suffix('.json').name}"
        )
    scale = np.array([1.0 / _scale(channel) for channel in columns])
    group = facts.get("JointfitGroup")
    if group not in GROUPS:
        turning = any(channel.quantity == ORIENTATION for channel in columns)
        group = "sensors" if turning else "markers"
    values = table[:, list(columns.values())] * scale
    return ChannelStream(
        cast("Group", group), str(facts.get("JointfitName", "")), t_s, tuple(columns), values
    )


def _read_motion(path: Path, width: int) -> Any:
    rows = []
    for at, line in enumerate(read_lines(path), start=1):
        cells = line.split("\t")
        if len(cells) != width:
            raise MalformedFileError(
                f"{path}, line {at}: {len(cells)} cells, expected {width}, one for each row of the"
                " channels file: export the data set again"
            )
        rows.append([number(path, at, "" if cell == _MISSING else cell) for cell in cells])
    return np.array(rows, np.float64).reshape(len(rows), width)


def _channel_of(row: Mapping[str, str]) -> StreamColumn | None:
    """Return the column from a channel's description, or else from its type; None if unknown."""
    quantity, _, component = row.get("description", "").partition(" ")
    item = row.get("tracked_point", "")
    placement = row.get("placement", _MISSING)
    placement = "" if placement == _MISSING else placement
    if quantity in UNITS:
        return StreamColumn(item, quantity, component, placement)
    for quantity, kind in _TYPES.items():
        if kind == row.get("type", "").upper() and kind != "JNTANG":
            return StreamColumn(
                item, quantity, row.get("component", "").removeprefix("quat_").lower()
            )
    return None


def _read_events(motion: Path) -> Iterable[TimelineEvent]:
    path = motion.with_name(motion.name.split("_tracksys-")[0] + "_events.tsv")
    if not path.exists():
        return
    rows = [line.split("\t") for line in read_lines(path)]
    for at, row in enumerate(rows[1:], start=2):
        cells = dict(zip(rows[0], row, strict=False))
        known = {key: "" if cell == _MISSING else cell for key, cell in cells.items()}
        onset = number(path, at, known.get("onset", ""))
        data = known.get("data") or "{}"
        yield TimelineEvent(
            onset,
            known.get("trial_type") or "event",
            known.get("id", ""),
            known.get("text", ""),
            orjson.loads(data),
        )
