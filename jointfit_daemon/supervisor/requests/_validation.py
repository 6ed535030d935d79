"""Requests as they come over MQTT, checked.

Invariant: no payload, topic or property raises an exception or costs more than linear time. Size
and nesting are bounded before the payload is parsed, and answers before they are written.
"""

from __future__ import annotations

import re
import time
from typing import TYPE_CHECKING, Any, Literal

import orjson
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jointfit_daemon.config import Fault, faults_of
from jointfit_daemon.nearest_name import nearest_name
from jointfit_daemon.outputs.mqtt import SignatureRejectedError, command_of
from jointfit_daemon.pipeline.events import Reply, Request

if TYPE_CHECKING:
    from jointfit_daemon.outputs.mqtt import Incoming
    from jointfit_daemon.supervisor.requests._authentication import RequestAuthenticator

LONGEST_BYTES = 4096
"""Limit of a payload; a signed request with a long transaction takes a quarter of it."""
MOST_KEYS = 16
"""Limit of the keys in a request; `calibrate` knows seven, those of the signature included."""
LONGEST_TEXT = 256
"""Limit in characters of `transaction` and of the response topic."""
LONGEST_CORRELATION_BYTES = 256
"""Limit of the correlation data."""
_MOST_BRACKETS = 64
"""Limit of opening brackets: a request is flat, and has one outside of its texts."""
_MOST_FAULTS = 8
"""Faults listed in an answer; the others are counted."""
_LONGEST_KEY, _LONGEST_MESSAGE = 80, 400
"""Limits of the texts in an answer, in characters."""
_COMMAND = re.compile(r"[A-Za-z0-9_-]{1,32}")
"""What may be a command: another name is not repeated on a topic."""
_RESPONSE_LEVELS = re.compile(r"[\w.:~-]{1,64}(/[\w.:~-]{1,64}){0,3}", re.ASCII)
"""Levels below ``bridge/response/`` that a caller may ask for."""


class _Arguments(BaseModel):
    """Base of every request: unknown keys are refused, text is no number."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    transaction: str = Field("", max_length=256, description="the caller's mark, sent back")


class CalibrateArguments(_Arguments):
    """``bridge/request/calibrate``."""

    phase: Literal["align", "static", "functional", "abort", "revert"] = Field(
        description="the phase to begin, or `abort`; `revert` takes back what was learned online"
    )
    seconds: float | None = Field(
        None, gt=0, le=600, description="length of the phase, s; default: as in rig.toml"
    )
    force: bool = Field(False, description="store the result even if it is worse than the last")


COMMANDS: dict[str, type[_Arguments]] = {"calibrate": CalibrateArguments}


def parse_request(
    message: Incoming, guard: RequestAuthenticator | None = None
) -> Request | Reply | None:
    """Return the request in `message`, or the reply that says all that is wrong with it.

    Parameters
    ----------
    message
        As it came.
    guard
        Judges who may ask, before anything else is looked at; None: the broker did.

    Returns
    -------
    Request, Reply or None
        None where no answer is due: the last level of the topic cannot be a command.
    """
    command = command_of(message)
    if not _COMMAND.fullmatch(command):
        return None
    table, fault = _table(message.payload)
    fault = fault or _property_fault(message)
    if guard is not None and fault is None:
        try:
            table = guard.check(message.topic, table)
        except SignatureRejectedError as refused:
            fault = Fault("signature", str(refused))
    transaction = _transaction(table)
    if fault is not None:
        return _refusal(command, transaction, [fault])

    model = COMMANDS.get(command)
    if model is None:
        known = f"no such request; known: {', '.join(COMMANDS)}"
        fault = Fault("command", known, command, nearest_name(command, COMMANDS))
        return _refusal(command, transaction, [fault])
    try:
        arguments = model.model_validate(table)
    except ValidationError as error:
        return _refusal(command, transaction, faults_of(error, model, command))
    values = arguments.model_dump(exclude={"transaction"}, exclude_none=True)
    return Request(time.monotonic_ns(), command, transaction, values)


def _transaction(table: dict[str, Any]) -> str:
    given = table.get("transaction")
    return given if isinstance(given, str) and len(given) <= LONGEST_TEXT else ""


def _table(payload: bytes) -> tuple[dict[str, Any], Fault | None]:
    """Return the flat JSON object in `payload`, or an empty one and the fault."""
    if len(payload) > LONGEST_BYTES:
        text = f"has {len(payload)} bytes, expected at most {LONGEST_BYTES}"
        return {}, Fault("payload", text)
    if payload.count(b"[") + payload.count(b"{") > _MOST_BRACKETS:
        text = f"has more than {_MOST_BRACKETS} brackets, expected a flat JSON object"
        return {}, Fault("payload", text)
    try:
        table = orjson.loads(payload or b"{}")
    except orjson.JSONDecodeError as error:
        return {}, Fault("payload", f"is not JSON: {error}")
    if not isinstance(table, dict):
        return {}, Fault("payload", "expected a JSON object", table)
    if len(table) > MOST_KEYS:
        return {}, Fault("payload", f"has {len(table)} keys, expected at most {MOST_KEYS}")
    return table, None


def _property_fault(message: Incoming) -> Fault | None:
    """Return what is wrong with where and how the answer is wanted."""
    if message.response_topic is not None and reply_topic(message) is None:
        text = (
            f"the response topic must begin with {_response_root(message)}, followed by one to "
            "four levels of at most 64 letters, digits, _ . : ~ -"
        )
        return Fault("response_topic", text, message.response_topic)
    if message.correlation is not None and len(message.correlation) > LONGEST_CORRELATION_BYTES:
        text = (
            f"the correlation data has {len(message.correlation)} bytes, expected at most "
            f"{LONGEST_CORRELATION_BYTES}"
        )
        return Fault("correlation_data", text)
    return None


def reply_topic(message: Incoming) -> str | None:
    """Return where the caller wants its answer; None: on the usual topic.

    Only topics below ``bridge/response/`` are granted: else a caller could write on `pose`.
    """
    topic = message.response_topic
    if topic is None or len(topic) > LONGEST_TEXT:
        return None
    root = _response_root(message)
    granted = topic.startswith(root) and _RESPONSE_LEVELS.fullmatch(topic, len(root))
    return topic if granted else None


def _response_root(message: Incoming) -> str:
    return f"{message.topic.rpartition('/bridge/request/')[0]}/bridge/response/"


def reply_correlation(message: Incoming) -> bytes | None:
    """Return the correlation data to send back, if it is within the limit."""
    data = message.correlation
    return data if data is not None and len(data) <= LONGEST_CORRELATION_BYTES else None


def _refusal(command: str, transaction: str, faults: list[Fault]) -> Reply:
    """Return a bounded answer that lists `faults`."""
    lines = [
        {"key": _cut(fault.key, _LONGEST_KEY), "message": _cut(fault.text(), _LONGEST_MESSAGE)}
        for fault in faults[:_MOST_FAULTS]
    ]
    error: dict[str, Any] = {
        "key": ", ".join(line["key"] for line in lines),
        "message": "; ".join(line["message"] for line in lines),
        "faults": lines,
        "more": len(faults) - len(lines),
    }
    return Reply(command, transaction, "error", {}, error)


def _cut(text: str, longest: int) -> str:
    return text if len(text) <= longest else f"{text[: longest - 1]}…"
