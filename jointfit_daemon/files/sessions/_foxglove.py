"""Sessions as MCAP files with the schemas of Foxglove, for the viewers Foxglove and Rerun.

| topic | message | content |
|---|---|---|
| ``/tf`` | FrameTransforms | orientations of sensors and segments; positions of joints |
| ``/markers`` | PosesInFrame | positions of the visible markers |
| ``/joints/NAME`` | JSON | angles and standard deviations in degrees, position in m |
| ``/events`` | Log | events |

Unknown orientations and occluded markers are omitted. The topics and coordinate frames of segments
and joints that were computed from the markers begin with ``optical``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import orjson
from mcap.writer import CompressionType, Writer

import jointfit_daemon
from jointfit_daemon.files.sessions._missing_extra import import_extra
from jointfit_daemon.files.sessions._written_session import WrittenSession

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.session_data import JointSeries, SessionData

_WORLD, _OPTICAL_WORLD = "world", "optical_world"
_INFO, _WARNING = 2, 3
"""Numbers of the levels in the schema foxglove.Log."""
_JOINT_SCHEMA = {
    "title": "jointfit.Joint",
    "type": "object",
    "properties": {
        "angles_deg": {"type": "object", "additionalProperties": {"type": ["number", "null"]}},
        "sd_deg": {"type": "object", "additionalProperties": {"type": ["number", "null"]}},
        "position_m": {"type": ["array", "null"], "items": {"type": "number"}},
        "position_sd_m": {"type": ["number", "null"]},
    },
}
_Message = tuple[float, str, str, Any]
"""One message: time since the start of the session, s; topic; schema; protobuf message or JSON
object."""


def write_foxglove_session(session: SessionData, folder: Path) -> WrittenSession:
    """Write ``NAME.foxglove.mcap`` with messages in the order of their times.

    Raises
    ------
    MissingPackageError
        The packages of the optional extra ``foxglove`` are not installed.
    """
    builder = _MessageBuilder(session.start_unix_ns or 0)
    messages = [
        *builder.transforms(session),
        *builder.markers(session),
        *builder.joints("/joints", session.joints),
        *builder.joints("/optical/joints", session.optical_joints),
        *builder.events(session),
    ]
    messages.sort(key=lambda message: message[0])

    path = folder / f"{session.name}.foxglove.mcap"
    channels: dict[str, int] = {}
    schemas: dict[str, int] = {}
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(library=f"jointfitd {jointfit_daemon.__version__}")
        writer.add_metadata("jointfit", {"name": session.name, **session.description})
        for t_s, topic, schema, content in messages:
            encoding = "json" if isinstance(content, dict) else "protobuf"
            if topic not in channels:
                if schema not in schemas:
                    schemas[schema] = builder.register(writer, schema, content)
                channels[topic] = writer.register_channel(topic, encoding, schemas[schema])
            data = (
                orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)
                if isinstance(content, dict)
                else content.SerializeToString()
            )
            at = builder.unix_ns(t_s)
            writer.add_message(channels[topic], log_time=at, data=data, publish_time=at)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it without types
    return WrittenSession((path,))


class _MessageBuilder:
    """Converts series to messages, and imports the optional schemas once."""

    def __init__(self, start_unix_ns: int) -> None:
        self._start_unix_ns = start_unix_ns
        self._transforms, self._poses_in_frame, self._log = (
            getattr(import_extra(f"foxglove_schemas_protobuf.{name}_pb2", "foxglove"), name)
            for name in ("FrameTransforms", "PosesInFrame", "Log")
        )
        self._register = import_extra("mcap_protobuf.schema", "foxglove").register_schema

    def unix_ns(self, t_s: float) -> int:
        """Return the UNIX time of an instant, ns; at least 0."""
        return max(self._start_unix_ns + round(t_s * 1e9), 0)

    def register(self, writer: Writer, name: str, content: Any) -> int:
        """Register the schema of a message, and return the number of the schema."""
        if isinstance(content, dict):
            return int(writer.register_schema(name, "jsonschema", orjson.dumps(_JOINT_SCHEMA)))
        return int(self._register(writer, type(content)))

    def transforms(self, session: SessionData) -> Iterator[_Message]:
        """Yield the orientations of sensors and segments, and the positions of joints."""
        for sensor in session.sensors:
            yield from self._poses(_WORLD, sensor.id, sensor.t_s, sensor.orientation, None)
        for world, prefix, segments, joints in (
            (_WORLD, "", session.segments, session.joints),
            (_OPTICAL_WORLD, "optical/", session.optical_segments, session.optical_joints),
        ):
            for segment in segments:
                name = prefix + segment.name
                yield from self._poses(world, name, segment.t_s, segment.orientation, None)
            for joint in joints:
                if joint.position is not None:
                    name = f"{prefix}joint/{joint.name}"
                    yield from self._poses(world, name, joint.t_s, None, joint.position)

    def _poses(
        self, world: str, name: str, t_s: Array, q: Array | None, place: Array | None
    ) -> Iterator[_Message]:
        """Yield the poses of a coordinate frame at all instants with known values.

        If `q` is None, the frame is not rotated. If `place` is None, the frame is at the origin of
        the world.
        """
        turns = np.tile([1.0, 0.0, 0.0, 0.0], (len(t_s), 1)) if q is None else q
        places = np.zeros((len(t_s), 3)) if place is None else place
        poses = np.column_stack((t_s, turns, places))
        for t, w, x, y, z, px, py, pz in poses[~np.isnan(poses).any(axis=1)].tolist():
            message = self._transforms()
            one = message.transforms.add(parent_frame_id=world, child_frame_id=name)
            one.timestamp.FromNanoseconds(self.unix_ns(t))
            one.rotation.w, one.rotation.x, one.rotation.y, one.rotation.z = w, x, y, z
            one.translation.x, one.translation.y, one.translation.z = px, py, pz
            yield t, "/tf", "foxglove.FrameTransforms", message

    def markers(self, session: SessionData) -> Iterator[_Message]:
        """Yield the visible markers of every frame."""
        if session.markers is None:
            return
        for t, places in zip(session.markers.t_s.tolist(), session.markers.positions, strict=True):
            message = self._poses_in_frame(frame_id=_OPTICAL_WORLD)
            message.timestamp.FromNanoseconds(self.unix_ns(t))
            for x, y, z in places[~np.isnan(places).any(axis=1)].tolist():
                pose = message.poses.add()
                pose.position.x, pose.position.y, pose.position.z = x, y, z
                pose.orientation.w = 1.0
            yield t, "/markers", "foxglove.PosesInFrame", message

    def joints(self, topic: str, joints: Sequence[JointSeries]) -> Iterator[_Message]:
        """Yield the angles and positions of all joints."""
        for joint in joints:
            angles = {name: np.rad2deg(values) for name, values in joint.angles.items()}
            sds = {name: np.rad2deg(values) for name, values in joint.angle_sd.items()}
            for k, t in enumerate(joint.t_s.tolist()):
                place = None if joint.position is None else joint.position[k]
                known = place is not None and not np.isnan(place).any()
                sd = None if joint.position_sd is None else float(joint.position_sd[k])
                content = {
                    "angles_deg": {name: float(values[k]) for name, values in angles.items()},
                    "sd_deg": {name: float(values[k]) for name, values in sds.items()},
                    "position_m": place if known else None,
                    "position_sd_m": sd,
                }
                yield t, f"{topic}/{joint.name}", "jointfit.Joint", content

    def events(self, session: SessionData) -> Iterator[_Message]:
        """Yield every event."""
        for event in session.events:
            message = self._log(
                level=_WARNING if event.kind in ("fault", "gap") else _INFO,
                name=event.id or event.kind,
                message=f"{event.kind}: {event.text}" if event.text else event.kind,
            )
            message.timestamp.FromNanoseconds(self.unix_ns(event.t_s))
            yield event.t_s, "/events", "foxglove.Log", message
