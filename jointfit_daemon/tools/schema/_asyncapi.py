"""AsyncAPI 3 document of the MQTT interface, from the tables of topics, payloads and requests."""

from __future__ import annotations

import re
from typing import Any

from jointfit_daemon import __version__
from jointfit_daemon.outputs.payload_models import answer_schema, payload_schema
from jointfit_daemon.outputs.topics import REQUEST, RESPONSE, TOPICS, Topic
from jointfit_daemon.supervisor.requests import REQUESTS

_PLACEHOLDERS = {
    "ID": "id of a device in rig.toml; the id of the optical system is mocap",
    "NAME": "name of a joint",
}
_SIGNATURE = {
    "t_us": {"type": "integer", "description": "UNIX time of the request, µs; at most 30 s old"},
    "nonce": {"type": "string", "pattern": "^[A-Za-z0-9-]{16,64}$"},
    "signature": {"type": "string", "description": "HMAC-SHA256 in hexadecimal"},
}
"""Schema of the keys that a signed request contains in addition."""


def request_schema(name: str) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of a request, including the signature keys."""
    schema = REQUESTS[name].model.model_json_schema()
    schema["properties"] = schema["properties"] | _SIGNATURE
    return schema


def asyncapi_document() -> dict[str, Any]:
    """Return the document: one channel for each topic, request and answer.

    The document describes the daemon's view: the daemon sends states and streams, and receives
    requests.
    """
    channels: dict[str, Any] = {}
    operations: dict[str, Any] = {}
    schemas: dict[str, Any] = {}

    def add(topic: Topic, pattern: str, schema: dict[str, Any]) -> str:
        title = schema["title"]
        schemas[title] = _move_references(schema, f"#/components/schemas/{title}")

        # The key of the channel is the topic pattern with underscores.
        channels[key := re.sub(r"[^A-Za-z0-9]", "_", pattern)] = _channel(topic, pattern, title)
        return key

    for topic in TOPICS:
        if topic not in (REQUEST, RESPONSE):
            key = add(topic, topic.pattern, payload_schema(topic))
            operations[f"send_{key}"] = _operation("send", key, topic)

    for name, kind in REQUESTS.items():
        asked, answered = (topic.pattern.replace("COMMAND", name) for topic in (REQUEST, RESPONSE))
        key = add(REQUEST, asked, request_schema(name))
        answer = add(RESPONSE, answered, answer_schema(name))
        operations[f"receive_{key}"] = {
            **_operation("receive", key, REQUEST),
            "summary": kind.effect,
            "reply": {"channel": {"$ref": f"#/channels/{answer}"}},
        }
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "jointfitd",
            "version": __version__,
            "description": "Joint positions and angles over MQTT; docs/mqtt.md explains the keys.",
        },
        "defaultContentType": "application/json",
        "servers": {
            "broker": {
                "host": "{host}:1883",
                "protocol": "mqtt",
                "protocolVersion": "5.0",
                "variables": {"host": {"default": "127.0.0.1"}},
            }
        },
        "channels": channels,
        "operations": operations,
        "components": {"schemas": schemas},
    }


def _channel(topic: Topic, pattern: str, title: str) -> dict[str, Any]:
    """Return the channel of a topic; its payload has the schema `title`."""
    names = {level for level in pattern.split("/") if level.isupper()}
    address = re.sub(r"\b([A-Z]+)\b", lambda found: f"{{{found[1].lower()}}}", pattern)
    base = "[mqtt] base of rig.toml, by default jointfit/ and the name of the rig"
    return {
        "address": f"{{base}}/{address}",
        "description": f"{'retained, ' if topic.retained else ''}QoS {topic.qos}",
        "parameters": {
            "base": {"description": base},
            **{name.lower(): {"description": _PLACEHOLDERS[name]} for name in sorted(names)},
        },
        "messages": {
            title: {
                "contentType": "application/json",
                "payload": {"$ref": f"#/components/schemas/{title}"},
            }
        },
    }


def _operation(action: str, key: str, topic: Topic) -> dict[str, Any]:
    return {
        "action": action,
        "channel": {"$ref": f"#/channels/{key}"},
        "bindings": {"mqtt": {"qos": topic.qos, "retain": topic.retained}},
    }


def _move_references(schema: Any, place: str) -> Any:
    """Return a schema whose references point to its definitions at `place`."""
    if isinstance(schema, list):
        return [_move_references(item, place) for item in schema]
    if not isinstance(schema, dict):
        return schema
    moved = {key: _move_references(value, place) for key, value in schema.items()}
    if "$defs" in moved:
        moved["definitions"] = moved.pop("$defs")
    reference = moved.get("$ref")
    if isinstance(reference, str):
        moved["$ref"] = reference.replace("#/$defs/", f"{place}/definitions/")
    return moved
