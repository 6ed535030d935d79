"""Models of all payloads, the source of their JSON Schemas; the daemon does not load them.

Invariant: every topic that the daemon publishes has one model, and every published payload fits its
model.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jointfit_daemon.outputs import topics
from jointfit_daemon.outputs.payload_models import _state, _streams
from jointfit_daemon.outputs.payload_models._answers import (
    ANSWERS,
    CalibrationsAnswer,
    StoredVersion,
)
from jointfit_daemon.outputs.payload_models._state import (
    CalibrationState,
    DeviceCounts,
    EventMessage,
    Health,
    Info,
    Latency,
    Progress,
    RecordingState,
    State,
)
from jointfit_daemon.outputs.payload_models._streams import OpticalPose, Pose, PoseJoint

__all__ = [
    "ANSWERS",
    "PAYLOADS",
    "CalibrationState",
    "CalibrationsAnswer",
    "DeviceCounts",
    "EventMessage",
    "Health",
    "Info",
    "Latency",
    "OpticalPose",
    "Pose",
    "PoseJoint",
    "Progress",
    "RecordingState",
    "State",
    "StoredVersion",
    "answer_schema",
    "payload_schema",
    "payload_topic",
]

if TYPE_CHECKING:
    from jointfit_daemon.outputs.payload_models._streams import Payload
    from jointfit_daemon.outputs.topics import Topic

PAYLOADS: dict[Topic, type[Payload]] = {
    topics.BRIDGE_STATE: _state.State,
    topics.BRIDGE_INFO: _state.Info,
    topics.BRIDGE_HEALTH: _state.Health,
    topics.BRIDGE_EVENT: _state.EventMessage,
    topics.BRIDGE_LOG: _state.LogLine,
    topics.RESPONSE: _state.Response,
    topics.CALIBRATION: _state.CalibrationState,
    topics.CALIBRATION_PROGRESS: _state.Progress,
    topics.DEVICE_AVAILABILITY: _state.State,
    topics.DEVICE_INFO: _state.DeviceFacts,
    topics.POSE: _streams.Pose,
    topics.POSE_UI: _streams.Pose,
    topics.OPTICAL_POSE: _streams.OpticalPose,
    topics.OPTICAL_CHAIN: _streams.OpticalChain,
    topics.SENSORS_POSE: _streams.SensorsPose,
    topics.OPTICAL_CENTERS: _streams.OpticalCenters,
    topics.OPTICAL_STICKS: _streams.OpticalSticks,
    topics.JOINT: _streams.JointScalars,
    topics.LATE_EVENT: _state.EventMessage,
    topics.LATE_POSE: _streams.Pose,
}
"""Model of each topic that the daemon publishes."""


def payload_schema(topic: Topic) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of the payload of a topic.

    Further keys are permitted, because readers must ignore unknown keys.
    """
    schema: dict[str, Any] = _open(PAYLOADS[topic].model_json_schema())
    return schema


def answer_schema(request: str) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of the answer to a request.

    In an answer that reports an error, ``data`` is empty.
    """
    schema, data = payload_schema(topics.RESPONSE), _open(ANSWERS[request].model_json_schema())
    definitions = data.pop("$defs", {}) | {data["title"]: data}
    schema["title"] = f"{data['title']}Message"
    schema["$defs"] = schema["$defs"] | definitions
    empty = {"type": "object", "maxProperties": 0}
    schema["properties"]["data"] = {"anyOf": [{"$ref": f"#/$defs/{data['title']}"}, empty]}
    return schema


def payload_topic(name: str) -> Topic | None:
    """Return the topic of a name below the base, such as ``joint/knee``.

    The result is None for requests and for unknown names.
    """
    levels = name.split("/")
    for topic in PAYLOADS:
        pattern = topic.pattern.split("/")
        if len(pattern) == len(levels) and all(
            a.isupper() or a == b for a, b in zip(pattern, levels, strict=True)
        ):
            return topic
    return None


def _open(schema: Any) -> Any:
    """Return a schema that permits further keys."""
    if isinstance(schema, list):
        return [_open(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    return {
        key: _open(value)
        for key, value in schema.items()
        if (key, value) != ("additionalProperties", False)
    }
