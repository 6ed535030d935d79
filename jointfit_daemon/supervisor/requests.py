"""Requests as they come over MQTT, checked.

Law: nothing a stranger sends can raise; every fault is told at once; one answer each, always.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Literal

import orjson
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jointfit_daemon.config.faults import Fault, faults_of, nearest
from jointfit_daemon.outputs.mqtt_signature import NotSigned
from jointfit_daemon.outputs.publisher import command_of
from jointfit_daemon.pipeline.events import Reply, Request

if TYPE_CHECKING:
    from jointfit_daemon.outputs.mqtt import Incoming
    from jointfit_daemon.supervisor.request_guard import RequestGuard

LONGEST_BYTES = 16 * 1024  # a request is a line of JSON
_NOT_IN_TOPICS = ("#", "+", "\0")


class _Arguments(BaseModel):
    """Base of every request: unknown keys are refused, text is no number."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    transaction: str = Field("", max_length=256, description="the caller's mark, sent back")


class CalibrateArguments(_Arguments):
    """``bridge/request/calibrate``."""

    phase: Literal["align", "static", "functional", "abort", "unlearn"] = Field(
        description="the phase to begin, or `abort`; `unlearn` takes back what was learned online"
    )
    seconds: float | None = Field(
        None, gt=0, le=600, description="length of the phase, s; default: as in rig.toml"
    )
    force: bool = Field(False, description="store the result even if it is worse than the last")


COMMANDS: dict[str, type[_Arguments]] = {"calibrate": CalibrateArguments}


def request_of(message: Incoming, guard: RequestGuard | None = None) -> Request | Reply:
    """Return the request in `message`, or the reply that says all that is wrong with it.

    Parameters
    ----------
    message
        As it came.
    guard
        Judges who may ask, before anything else is looked at; None: the broker did.
    """
    command = command_of(message)
    table, fault = _table(message.payload)
    if guard is not None and fault is None:
        try:
            table = guard.check(message.topic, table)
        except NotSigned as refused:
            fault = Fault("signature", str(refused))
            return _refusal(command, _transaction(table), [fault])
    transaction = _transaction(table)
    model = COMMANDS.get(command)
    if model is None:
        known = f"no such request; known: {', '.join(COMMANDS)}"
        fault = Fault("command", known, command, nearest(command, COMMANDS))
    if fault is not None or model is None:
        return _refusal(command, transaction, [fault] if fault is not None else [])
    try:
        arguments = model.model_validate(table)
    except ValidationError as error:
        return _refusal(command, transaction, faults_of(error, model, command))
    values = arguments.model_dump(exclude={"transaction"}, exclude_none=True)
    return Request(time.monotonic_ns(), command, transaction, values)


def _transaction(table: dict[str, Any]) -> str:
    given = table.get("transaction")
    return given if isinstance(given, str) else ""


def _table(payload: bytes) -> tuple[dict[str, Any], Fault | None]:
    if len(payload) > LONGEST_BYTES:
        return {}, Fault("payload", f"longer than {LONGEST_BYTES} bytes")
    try:
        table = orjson.loads(payload or b"{}")
    except orjson.JSONDecodeError as error:
        return {}, Fault("payload", f"is not JSON: {error}")
    if not isinstance(table, dict):
        return {}, Fault("payload", "expected a JSON object", table)
    return table, None


def reply_topic(message: Incoming) -> str | None:
    """Return where the caller wants its answer; None: on the usual topic."""
    topic = message.response_topic or ""
    usable = topic and topic[0] != "$" and not any(bad in topic for bad in _NOT_IN_TOPICS)
    return topic if usable else None


def _refusal(command: str, transaction: str, faults: list[Fault]) -> Reply:
    lines = [{"key": fault.key, "message": fault.text()} for fault in faults]
    error: dict[str, Any] = {
        "key": ", ".join(line["key"] for line in lines),
        "message": "; ".join(line["message"] for line in lines),
        "faults": lines,
    }
    return Reply(command, transaction, "error", {}, error)
