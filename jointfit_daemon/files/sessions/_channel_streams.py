"""A session as streams of described channels, for XDF, Motion-BIDS and LSL.

Every channel names the object to which it belongs (sensor, marker, segment or joint), its quantity,
its component and its unit. Invariant: `session_of` converts the streams of `streams_of` back to the
same series of sensors, markers, segments and joints. Modes and flags of frames have no stream.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from jointfit_daemon.session_data import (
    JointSeries,
    MarkerSeries,
    SegmentSeries,
    SensorSeries,
    SessionData,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.session_data import TimelineEvent

Group = Literal[
    "sensors", "markers", "segments", "joints", "optical_segments", "optical_joints"
]  # fmt: skip
GROUPS: tuple[Group, ...] = (
    "sensors", "markers", "segments", "joints", "optical_segments", "optical_joints",
)  # fmt: skip
ORIENTATION, POSITION = "orientation", "position"
ANGLE, ANGLE_SD = "angle", "angle_sd"
ORIENTATION_SD, POSITION_SD = "orientation_sd", "position_sd"
UNITS = {
    ORIENTATION: "",
    ORIENTATION_SD: "rad",
    "angular_velocity": "rad/s",
    "acceleration": "m/s^2",
    "magnetic_field": "",
    POSITION: "m",
    POSITION_SD: "m",
    ANGLE: "rad",
    ANGLE_SD: "rad",
}
"""Unit of every quantity. It is empty if the quantity has no unit, or if the sensor defines the
unit."""
_INERTIAL = ("angular_velocity", "acceleration", "magnetic_field")


class StreamColumn(NamedTuple):
    """Description of one column of a stream."""

    object: str
    """Name of the sensor, marker, segment or joint."""
    quantity: str
    """Key of `UNITS`."""
    component: str = ""
    """``w``, ``x``, ``y``, ``z``, or the name of an angle; empty for a scalar."""
    placement: str = ""
    """Name of the segment that carries the sensor; empty for other objects."""

    @property
    def unit(self) -> str:
        """Unit of the column; empty if it has none."""
        return UNITS[self.quantity]

    @property
    def label(self) -> str:
        """Name of the column, unique within its stream."""
        return "_".join(filter(None, (self.object, self.quantity, self.component)))


@dataclass(frozen=True, slots=True, eq=False)
class ChannelStream:
    """Channels that share their sample times."""

    group: Group
    name: str
    """Name of the object; the name of the group if the stream contains several objects."""
    t_s: Array
    """Instants since the start of the session, s, shape (n,)."""
    channels: tuple[StreamColumn, ...]
    values: Array
    """Samples of the channels, shape (n, len(channels)); NaN where unknown."""


def streams_of(session: SessionData) -> list[ChannelStream]:
    """Return one stream for each series of a session."""
    streams = []
    for sensor in session.sensors:
        columns = _vectors(sensor.id, ORIENTATION, sensor.orientation, "wxyz", sensor.segment)
        for quantity in _INERTIAL:
            values = getattr(sensor, quantity)
            columns |= _vectors(sensor.id, quantity, values, "xyz", sensor.segment)
        streams.append(_stream("sensors", sensor.id, sensor.t_s, columns))
    if session.markers is not None:
        columns = {}
        for k, label in enumerate(session.markers.labels):
            columns |= _vectors(label, POSITION, session.markers.positions[:, k], "xyz")
        streams.append(_stream("markers", "markers", session.markers.t_s, columns))

    for group in ("segments", "optical_segments"):
        for segment in getattr(session, group):
            columns = _vectors(segment.name, ORIENTATION, segment.orientation, "wxyz")
            columns |= _scalar(segment.name, ORIENTATION_SD, segment.sd_rad)
            streams.append(_stream(group, segment.name, segment.t_s, columns))
    for group in ("joints", "optical_joints"):
        for joint in getattr(session, group):
            angles, sds = joint.angles.items(), joint.angle_sd.items()
            columns = {StreamColumn(joint.name, ANGLE, name): angle for name, angle in angles}
            columns |= {StreamColumn(joint.name, ANGLE_SD, name): sd for name, sd in sds}
            columns |= _vectors(joint.name, POSITION, joint.position, "xyz")
            columns |= _scalar(joint.name, POSITION_SD, joint.position_sd)
            streams.append(_stream(group, joint.name, joint.t_s, columns))
    return streams


def merge_streams(streams: Sequence[ChannelStream]) -> list[ChannelStream]:
    """Return the streams; the streams of a group become one if all of them have the same times."""
    merged = []
    for group in GROUPS:
        own = [stream for stream in streams if stream.group == group]
        if len(own) > 1 and all(np.array_equal(own[0].t_s, stream.t_s) for stream in own):
            channels = tuple(channel for stream in own for channel in stream.channels)
            values = np.concatenate([stream.values for stream in own], axis=1)
            own = [ChannelStream(group, group, own[0].t_s, channels, values)]
        merged += own
    return merged


def session_of(
    streams: Iterable[ChannelStream],
    name: str,
    *,
    start_unix_ns: int | None = None,
    events: Sequence[TimelineEvent] = (),
    description: Mapping[str, str] | None = None,
) -> SessionData:
    """Return the session that consists of the given streams, events and description."""
    found: dict[str, list[Any]] = {group: [] for group in GROUPS}
    markers: MarkerSeries | None = None
    for stream in streams:
        if stream.group == "markers":
            labels = tuple(dict.fromkeys(channel.object for channel in stream.channels))
            positions = [
                _fill_missing(_matrix(stream, label, POSITION, "xyz"), len(stream.t_s), 3)
                for label in labels
            ]
            cells = np.stack(positions, axis=1) if labels else np.empty((len(stream.t_s), 0, 3))
            markers = MarkerSeries(labels, stream.t_s, cells)
            continue
        for item in dict.fromkeys(channel.object for channel in stream.channels):
            found[stream.group].append(_series(stream, item))
    series: dict[str, Any] = {group: tuple(found[group]) for group in GROUPS if group != "markers"}
    return SessionData(
        name,
        start_unix_ns,
        markers=markers,
        events=tuple(events),
        description=dict(description or {}),
        **series,
    )


def _series(stream: ChannelStream, item: str) -> SensorSeries | SegmentSeries | JointSeries:
    """Return the time series of one object of a stream."""
    count = len(stream.t_s)
    if stream.group in ("joints", "optical_joints"):
        return JointSeries(
            item,
            stream.t_s,
            _columns_of(stream, item, ANGLE),
            _columns_of(stream, item, ANGLE_SD),
            _matrix(stream, item, POSITION, "xyz"),
            _columns_of(stream, item, POSITION_SD).get(""),
        )
    orientation = _fill_missing(_matrix(stream, item, ORIENTATION, "wxyz"), count, 4)
    if stream.group == "sensors":
        placement = next(c.placement for c in stream.channels if c.object == item)
        signals = (_matrix(stream, item, quantity, "xyz") for quantity in _INERTIAL)
        return SensorSeries(item, placement, stream.t_s, orientation, *signals)
    return SegmentSeries(
        item, stream.t_s, orientation, _columns_of(stream, item, ORIENTATION_SD).get("")
    )


def _vectors(
    item: str, quantity: str, values: Array | None, components: str, placement: str = ""
) -> dict[StreamColumn, Array]:
    if values is None:
        return {}
    return {
        StreamColumn(item, quantity, component, placement): values[:, k]
        for k, component in enumerate(components)
    }


def _scalar(item: str, quantity: str, values: Array | None) -> dict[StreamColumn, Array]:
    return {} if values is None else {StreamColumn(item, quantity): values}


def _stream(
    group: Any, name: str, t_s: Array, columns: Mapping[StreamColumn, Array]
) -> ChannelStream:
    values = np.column_stack(list(columns.values())) if columns else np.empty((len(t_s), 0))
    return ChannelStream(group, name, t_s, tuple(columns), values)


def _columns_of(stream: ChannelStream, item: str, quantity: str) -> dict[str, Array]:
    """Return the columns of one object and one quantity, by component."""
    return {
        channel.component: stream.values[:, k]
        for k, channel in enumerate(stream.channels)
        if channel.object == item and channel.quantity == quantity
    }


def _matrix(stream: ChannelStream, item: str, quantity: str, components: str) -> Array | None:
    """Return the columns of all components, shape (n, len(components)); None if one is missing."""
    columns = _columns_of(stream, item, quantity)
    if any(component not in columns for component in components):
        return None
    return np.column_stack([columns[component] for component in components])


def _fill_missing(values: Array | None, count: int, width: int) -> Array:
    return np.full((count, width), np.nan) if values is None else values
