"""Validation of MQTT requests.

Invariant: no payload, topic or property raises an exception, and the cost is at most proportional
to the size. Size and nesting are checked before the payload is parsed, and replies have a limited
size.
"""

from __future__ import annotations

import re
import time
from typing import TYPE_CHECKING, Any

import orjson
from pydantic import ValidationError

from jointfit_daemon.config import Fault, faults_of
from jointfit_daemon.nearest_name import nearest_name
from jointfit_daemon.outputs.mqtt import SignatureRejectedError
from jointfit_daemon.pipeline.events import Reply, ReplyAddress, Request
from jointfit_daemon.supervisor.requests._arguments import REQUESTS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.outputs.mqtt import Incoming
    from jointfit_daemon.supervisor.requests._authentication import RequestAuthenticator

LONGEST_BYTES = 4096
"""Largest payload, bytes. A signed request with a long transaction needs a quarter of it."""
MOST_KEYS = 16
"""Largest number of keys. `calibrate` has seven keys, including the keys of the signature."""
LONGEST_TEXT = 256
"""Longest `transaction` and response topic, characters."""
LONGEST_CORRELATION_BYTES = 256
"""Longest correlation data, bytes."""
_MOST_BRACKETS = 64
"""Largest number of opening brackets. A request is flat, so it has one bracket outside its
texts."""
_MOST_FAULTS = 8
"""Number of faults that a reply lists. Further faults are only counted."""
_LONGEST_KEY, _LONGEST_MESSAGE = 80, 400
"""Longest key and longest message in a reply, characters."""
_COMMAND = re.compile(r"[A-Za-z0-9_-]{1,32}")
"""Pattern of command names. A request with another name gets no reply, because the name would
become part of the topic of the reply."""
_RESPONSE_LEVELS = re.compile(r"[\w.:~-]{1,64}(/[\w.:~-]{1,64}){0,3}", re.ASCII)
"""Pattern of the topic levels below ``bridge/response/`` that a client may request."""


def parse_request(
    message: Incoming, authenticator: RequestAuthenticator | None = None
) -> Request | Reply | None:
    """Return the request in `message`, or a reply that lists all its faults.

    Parameters
    ----------
    message
        The received message.
    authenticator
        Object that checks the signature before the arguments are read. If it is None, all requests
        are accepted.

    Returns
    -------
    Request, Reply or None
        The request, or a reply with its faults. None means that no reply is sent, because the last
        level of the topic cannot be a command.
    """
    command = message.topic.rpartition("/")[2]
    if not _COMMAND.fullmatch(command):
        return None

    table, fault = _parse_table(message.payload)
    fault = fault or _property_fault(message)
    if authenticator is not None and fault is None:
        try:
            table = authenticator.check(message.topic, table)
        except SignatureRejectedError as refused:
            fault = Fault("signature", str(refused))

    given = table.get("transaction")
    transaction = given if isinstance(given, str) and len(given) <= LONGEST_TEXT else ""
    reply_to = _reply_address(message)
    if fault is not None:
        return _refusal(command, transaction, [fault], reply_to)

    kind = REQUESTS.get(command)
    if kind is None:
        known = f"unknown request; known: {', '.join(REQUESTS)}"
        fault = Fault("command", known, command, nearest_name(command, REQUESTS))
        return _refusal(command, transaction, [fault], reply_to)
    model = kind.model
    try:
        arguments = model.model_validate(table)
    except ValidationError as error:
        return _refusal(command, transaction, faults_of(error, model, command), reply_to)
    values = arguments.model_dump(exclude={"transaction"}, exclude_none=True)
    return Request(time.monotonic_ns(), command, transaction, values, reply_to)


def _parse_table(payload: bytes) -> tuple[dict[str, Any], Fault | None]:
    """Return the JSON object in `payload` and no fault, or an empty object and the fault."""
    if len(payload) > LONGEST_BYTES:
        text = f"has {len(payload)} bytes, expected at most {LONGEST_BYTES}"
        return {}, Fault("payload", text)
    if payload.count(b"[") + payload.count(b"{") > _MOST_BRACKETS:
        text = f"has more than {_MOST_BRACKETS} brackets, expected a flat JSON object"
        return {}, Fault("payload", text)

    try:
        table = orjson.loads(payload or b"{}")
    except orjson.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        return {}, Fault("payload", f"is not JSON in UTF-8 ({place}), expected a JSON object")
    if not isinstance(table, dict):
        return {}, Fault("payload", "expected a JSON object", table)
    if len(table) > MOST_KEYS:
        return {}, Fault("payload", f"has {len(table)} keys, expected at most {MOST_KEYS}")
    return table, None


def _property_fault(message: Incoming) -> Fault | None:
    """Return the fault of the response topic or of the correlation data; None without a fault."""
    address = _reply_address(message)
    if message.response_topic is not None and address.topic is None:
        text = (
            f"the response topic must begin with {_response_root(message)}, followed by one to "
            "four levels of at most 64 letters, digits, _ . : ~ -"
        )
        return Fault("response_topic", text, message.response_topic)
    if message.correlation is not None and address.correlation is None:
        text = (
            f"the correlation data has {len(message.correlation)} bytes, expected at most "
            f"{LONGEST_CORRELATION_BYTES}"
        )
        return Fault("correlation_data", text)
    return None


def _reply_address(message: Incoming) -> ReplyAddress:
    """Return requested topic and correlation data; values that are not permitted become None.

    Only topics below ``bridge/response/`` are permitted. Otherwise a client could write to `pose`.
    """
    topic = message.response_topic
    if topic is not None:
        root = _response_root(message)
        permitted = (
            len(topic) <= LONGEST_TEXT
            and topic.startswith(root)
            and _RESPONSE_LEVELS.fullmatch(topic, len(root))
        )
        topic = topic if permitted else None

    data = message.correlation
    if data is not None and len(data) > LONGEST_CORRELATION_BYTES:
        data = None
    return ReplyAddress(topic, data)


def _response_root(message: Incoming) -> str:
    return f"{message.topic.rpartition('/bridge/request/')[0]}/bridge/response/"


def _refusal(command: str, transaction: str, faults: list[Fault], reply_to: ReplyAddress) -> Reply:
    """Return a reply of limited size that contains `faults`."""
    return Reply(command, transaction, "error", {}, error_of(faults), reply_to)


def error_of(faults: Sequence[Fault]) -> dict[str, Any]:
    """Return the key ``error`` of an answer: the first faults, and the number of further faults."""
    lines = [
        {"key": _cut(fault.key, _LONGEST_KEY), "message": _cut(fault.text(), _LONGEST_MESSAGE)}
        for fault in faults[:_MOST_FAULTS]
    ]
    return {
        "key": ", ".join(line["key"] for line in lines),
        "message": "; ".join(line["message"] for line in lines),
        "faults": lines,
        "more": len(faults) - len(lines),
    }


def _cut(text: str, longest: int) -> str:
    return text if len(text) <= longest else f"{text[: longest - 1]}…"
