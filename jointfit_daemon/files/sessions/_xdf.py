"""Sessions as XDF files, the file format of the Lab Streaming Layer.

A file has one stream for each sensor, segment and joint, one stream for all markers, and one stream
of events. Time stamps are seconds since the start of the session, and the clock offset of every
stream is 0. If rows are missing, the nominal rate is 0 (irregular), so that readers do not change
the time stamps. Channels are described as proposed at
https://github.com/sccn/xdf/wiki/Mocap-Meta-Data.
"""

from __future__ import annotations

import struct
from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, cast
from xml.etree import ElementTree as ET

import numpy as np
import orjson

from jointfit_daemon.files.sessions._channel_streams import (
    GROUPS,
    ORIENTATION,
    POSITION,
    UNITS,
    ChannelStream,
    StreamColumn,
    session_of,
    streams_of,
)
from jointfit_daemon.files.sessions._written_session import WrittenSession
from jointfit_daemon.files.sessions._xdf_chunks import (
    CLOCK_OFFSET,
    FILE_HEADER,
    MAGIC,
    SAMPLES,
    STREAM_FOOTER,
    STREAM_HEADER,
    STRING,
    XdfStream,
    pack_chunk,
    pack_samples,
    pack_text,
    read_xdf_streams,
)
from jointfit_daemon.files.text import MalformedFileError
from jointfit_daemon.session_data import TimelineEvent, is_uniform, sample_rate_hz

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.files.sessions._channel_streams import Group
    from jointfit_daemon.session_data import SessionData

_EVENT_CHANNELS = ("kind", "id", "text", "data")
_EVENTS = "events"
_CHUNK_ROWS = 4096
"""Number of samples in a chunk."""
_MOCAP_WORDS = {ORIENTATION: "Orientation", POSITION: "Position"}
"""Channel types in the motion-capture meta-data of XDF, without the name of the axis."""


def write_xdf_session(session: SessionData, folder: Path) -> WrittenSession:
    """Write ``NAME.xdf``."""
    streams = streams_of(session)
    path = folder / f"{session.name}.xdf"
    with path.open("wb") as file:
        file.write(MAGIC + pack_chunk(FILE_HEADER, _file_header(session)))
        for number, stream in enumerate(streams, start=1):
            head = struct.pack("<I", number)
            file.write(pack_chunk(STREAM_HEADER, head + _stream_header(stream)))
            for k in range(0, len(stream.t_s), _CHUNK_ROWS):
                rows = slice(k, k + _CHUNK_ROWS)
                samples = pack_samples(stream.t_s[rows], stream.values[rows])
                file.write(pack_chunk(SAMPLES, head + samples))
            file.write(_stream_end(number, stream.t_s))

        number = len(streams) + 1
        head = struct.pack("<I", number)
        file.write(pack_chunk(STREAM_HEADER, head + _events_header()))
        for event in session.events:
            row = (event.kind, event.id, event.text, orjson.dumps(dict(event.data)).decode())
            sample = b"\x01\x01\x08" + struct.pack("<d", event.t_s) + b"".join(map(pack_text, row))
            file.write(pack_chunk(SAMPLES, head + sample))
        file.write(_stream_end(number, np.array([event.t_s for event in session.events])))
    return WrittenSession((path,))


def _file_header(session: SessionData) -> bytes:
    info = ET.Element("info")
    _add(info, "version", "1.0")
    if session.start_unix_ns is None:
        _add(info, "start_unix_ns", "unknown")  # the reader keeps the time stamps of such a file
    else:
        start = datetime.fromtimestamp(session.start_unix_ns / 1e9, UTC)
        _add(info, "datetime", start.isoformat(timespec="milliseconds"))
        _add(info, "start_unix_ns", str(session.start_unix_ns))
    _add(info, "name", session.name)
    _add(info, "description", orjson.dumps(dict(session.description)).decode())
    return _xml_bytes(info)


def stream_description(stream: ChannelStream) -> ET.Element:
    """Return the XML element ``desc`` of a stream, which contains the group and the channels."""
    description = ET.Element("desc")
    _add(description, "group", stream.group)
    channels = ET.SubElement(description, "channels")
    for channel in stream.channels:
        element = ET.SubElement(channels, "channel")
        _add(element, "label", channel.label)
        _add(element, "object", channel.object)
        word = _MOCAP_WORDS.get(channel.quantity)
        _add(element, "type", word + channel.component.upper() if word else channel.quantity)
        _add(element, "unit", {"m": "meters"}.get(channel.unit, channel.unit))
        _add(element, "quantity", channel.quantity)
        _add(element, "component", channel.component)
        _add(element, "placement", channel.placement)
    return description


def _stream_header(stream: ChannelStream) -> bytes:
    info = ET.Element("info")
    _add(info, "name", stream.name)
    _add(info, "type", "MoCap")
    _add(info, "channel_count", str(len(stream.channels)))
    rate_hz = sample_rate_hz(stream.t_s) if is_uniform(stream.t_s) else 0.0
    _add(info, "nominal_srate", repr(rate_hz if np.isfinite(rate_hz) else 0.0))
    _add(info, "channel_format", "double64")
    info.append(stream_description(stream))
    return _xml_bytes(info)


def _events_header() -> bytes:
    info = ET.Element("info")
    for name, text in (
        ("name", _EVENTS),
        ("type", "Markers"),
        ("channel_count", str(len(_EVENT_CHANNELS))),
        ("nominal_srate", "0"),
        ("channel_format", STRING),
    ):
        _add(info, name, text)
    channels = ET.SubElement(ET.SubElement(info, "desc"), "channels")
    for label in _EVENT_CHANNELS:
        _add(ET.SubElement(channels, "channel"), "label", label)
    return _xml_bytes(info)


def _stream_end(number: int, t_s: Array) -> bytes:
    """Return the last chunks of a stream: the clock offsets, which are all 0, and the footer."""
    info, head = ET.Element("info"), struct.pack("<I", number)
    first, last = (float(t_s[0]), float(t_s[-1])) if len(t_s) else (0.0, 0.0)
    _add(info, "first_timestamp", repr(first))
    _add(info, "last_timestamp", repr(last))
    _add(info, "sample_count", str(len(t_s)))
    offsets = [pack_chunk(CLOCK_OFFSET, head + struct.pack("<dd", t, 0.0)) for t in (first, last)]
    footer = _xml_bytes(info)
    return b"".join(offsets) + pack_chunk(STREAM_FOOTER, head + footer)


def _xml_bytes(info: ET.Element) -> bytes:
    text: bytes = ET.tostring(info, "utf-8", xml_declaration=True)
    return text


def _add(parent: ET.Element, name: str, text: str) -> None:
    ET.SubElement(parent, name).text = text


def read_xdf_session(path: Path) -> SessionData:
    """Return the session of an XDF file: all streams with described channels, and the events.

    Time stamps are corrected by the clock offsets. In files of other programs, streams of strings
    become events, and the first time stamp becomes 0 s. Channels with the types PositionX to
    PositionZ become markers, and channels with the types OrientationX to OrientationW become
    sensors.

    Raises
    ------
    MalformedFileError
        The file is not an XDF file, is damaged, or contains none of these streams.
    """
    header, found = read_xdf_streams(path)
    start = (header.findtext("start_unix_ns") or "").strip()
    numeric: list[ChannelStream] = []
    events: list[TimelineEvent] = []
    for stream in found:
        t_s = _corrected_times(path, stream)
        if stream.text("channel_format") == STRING:
            events += _read_events(stream, t_s)
        elif described := _read_channels(stream, t_s):
            numeric.append(described)

    if not numeric and not events and not start:
        kinds = ", ".join(f"{s.text('name')!r} ({s.text('type')})" for s in found) or "no streams"
        raise MalformedFileError(
            f"{path}: found {kinds}, expected streams of motion capture whose channels have the"
            " types PositionX or OrientationW, or streams of strings: describe the channels"
        )
    if not start:
        # The time stamps of a file of another program begin at 0 s.
        firsts = [s.t_s[0] for s in numeric if len(s.t_s)] + [event.t_s for event in events]
        first = float(min(firsts, default=0.0))
        numeric = [replace(stream, t_s=stream.t_s - first) for stream in numeric]
        events = [replace(event, t_s=event.t_s - first) for event in events]
    return session_of(
        numeric,
        path.stem,
        start_unix_ns=int(start) if start.lstrip("-").isdecimal() else None,
        events=sorted(events, key=lambda event: event.t_s),
        description=_read_description(header),
    )


def _read_description(header: ET.Element) -> dict[str, str]:
    try:
        found = orjson.loads(header.findtext("description") or "{}")
    except orjson.JSONDecodeError:
        return {}
    return {str(k): str(v) for k, v in found.items()} if isinstance(found, dict) else {}


def _corrected_times(path: Path, stream: XdfStream) -> Array:
    """Return time stamps plus clock offset, s.

    The clock offset is a straight line, fitted to the measured offsets.
    """
    t_s = np.concatenate(stream.t_s) if stream.t_s else np.empty(0)
    missing = np.isnan(t_s)
    if missing.any():
        if missing[0] or not stream.rate_hz:
            raise MalformedFileError(
                f"{path}: stream {stream.text('name')!r} has samples without time stamps and no"
                " nominal rate: export it again"
            )
        rows = np.arange(len(t_s))
        last = np.maximum.accumulate(np.where(missing, 0, rows))
        t_s = t_s[last] + (rows - last) / stream.rate_hz

    if not stream.offsets:
        return t_s
    at, offset = np.array(stream.offsets).T
    if np.ptp(at) == 0.0 or not np.isfinite(offset).all():
        return t_s + float(np.nan_to_num(offset).mean())
    slope, constant = np.polyfit(at - at[0], offset, 1)
    corrected: Array = t_s + constant + slope * (t_s - at[0])
    return corrected


def _read_events(stream: XdfStream, t_s: Array) -> list[TimelineEvent]:
    own = [channel.findtext("label") for channel in stream.header.findall("desc/channels/channel")]
    if tuple(own) != _EVENT_CHANNELS:
        name = stream.text("name")
        return [
            TimelineEvent(float(t), "mark", name, " ".join(row))
            for t, row in zip(t_s, stream.texts, strict=True)
        ]
    events = []
    for t, (kind, item, text, data) in zip(t_s, stream.texts, strict=True):
        parsed = orjson.loads(data or "{}")
        events.append(TimelineEvent(float(t), kind, item, text, parsed))
    return events


def _read_channels(stream: XdfStream, t_s: Array) -> ChannelStream | None:
    """Return the described channels of a stream; None if no channel is described."""
    elements = stream.header.findall("desc/channels/channel")[: stream.channels]
    columns: dict[StreamColumn, int] = {}
    for k, element in enumerate(elements):
        channel = _channel_of(element, stream.text("name"))
        if channel is not None:
            columns.setdefault(channel, k)
    if not columns and stream.channels:
        return None

    group = stream.text("desc/group")
    if group not in GROUPS:
        turning = any(channel.quantity == ORIENTATION for channel in columns)
        group = "sensors" if turning else "markers"
    values = np.concatenate(stream.values) if stream.values else np.empty((0, stream.channels))
    name = stream.text("name")
    selected = values[:, list(columns.values())]
    return ChannelStream(cast("Group", group), name, t_s, tuple(columns), selected)


def _channel_of(element: ET.Element, stream: str) -> StreamColumn | None:
    def text(name: str) -> str:
        return (element.findtext(name) or "").strip()

    if text("quantity") in UNITS:
        return StreamColumn(text("object"), text("quantity"), text("component"), text("placement"))
    item = text("object") or text("marker") or stream
    for quantity, word in _MOCAP_WORDS.items():
        if text("type").startswith(word) and len(text("type")) == len(word) + 1:
            return StreamColumn(item, quantity, text("type")[-1].lower())
    return None
