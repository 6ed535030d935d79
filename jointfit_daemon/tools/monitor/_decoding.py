"""Decoding of the daemon's MQTT payloads with their published data models.

Invariant: no other module of the monitor decodes payloads.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from jointfit_daemon.outputs.log import printable
from jointfit_daemon.outputs.payload_models import ANSWERS, PAYLOADS, payload_topic
from jointfit_daemon.outputs.topics import PAYLOAD_VERSION

if TYPE_CHECKING:
    from pydantic import BaseModel

_DEEPEST = 12
"""Maximum nesting depth of a payload. The quality of a calibration has 6 levels."""


class UnreadablePayloadError(Exception):
    """A payload does not match its model; the message names the key and the remedy."""


def decode(topic: str, payload: Any) -> BaseModel | None:
    """Return the payload as an object of its topic's model; None for an unknown topic.

    The topic is relative to the base topic. Control characters in texts and names are replaced by
    escapes, so no message can control the terminal. Unknown keys are ignored, as docs/mqtt.md
    requires.

    Raises
    ------
    UnreadablePayloadError
        A key is missing or has another type, or the payload has another version.
    """
    found = payload_topic(topic)
    return None if found is None else _validate(PAYLOADS[found], topic, payload)


def decode_answer(command: str, data: Any) -> BaseModel:
    """Return the ``data`` of an answer as its model, with the same errors as `decode`."""
    return _validate(ANSWERS[command], f"bridge/response/{command}", data)


def _validate(model: type[BaseModel], topic: str, payload: Any) -> BaseModel:
    if not isinstance(payload, dict):
        raise UnreadablePayloadError(f"{topic}: no JSON object; another program publishes here")
    version = payload.get("v", PAYLOAD_VERSION)
    if version != PAYLOAD_VERSION:
        raise UnreadablePayloadError(
            f"{topic}: payload version {version!r:.20}, this program reads {PAYLOAD_VERSION}:"
            " install the version of jointfitd that runs on the gateway"
        )
    payload = _printable(payload, topic)
    try:
        return model.model_validate(payload)
    except ValidationError as error:
        faults = error.errors(include_url=False, include_context=False, include_input=False)
    for fault in faults:
        if fault["type"] == "extra_forbidden":
            # Remove the unknown key, which a newer daemon may have sent.
            table = payload
            *path, last = fault["loc"]
            for part in path:
                table = table[part]
            del table[last]
    try:
        return model.model_validate(payload)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    key = ".".join(str(part) for part in first["loc"])
    raise UnreadablePayloadError(
        f"{topic}: {key}: {first['msg'].lower()}; the daemon has another version"
    )


def _printable(value: Any, topic: str, depth: int = 0) -> Any:
    """Return a copy of a JSON value with `printable` applied to its texts, keys included."""
    if depth > _DEEPEST:
        raise UnreadablePayloadError(f"{topic}: nested deeper than {_DEEPEST} levels")
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, dict):
        return {printable(key): _printable(each, topic, depth + 1) for key, each in value.items()}
    if isinstance(value, list):
        return [_printable(each, topic, depth + 1) for each in value]
    return value
