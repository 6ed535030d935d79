"""JSON form of the input events and outputs of the core in a recording.

Invariant: conversion to JSON and back returns an equal event, except for the reply address of a
request. The bytes of a `ChunkArrived` are recorded unchanged, not as JSON.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import orjson

from jointfit_daemon.calibration import FitResult
from jointfit_daemon.config import parse_rig
from jointfit_daemon.limb_model import Calibration
from jointfit_daemon.pipeline.events import (
    CalibrationSelected,
    CalibrationStored,
    Configured,
    JobFinished,
    JobProgress,
    Request,
    SourceClosed,
    SourceOpened,
    Tick,
    UnixOffset,
)

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from jointfit_daemon.model import LimbState

UnchunkedEvent: TypeAlias = (
    Tick
    | Configured
    | SourceOpened
    | SourceClosed
    | Request
    | CalibrationSelected
    | JobFinished
    | JobProgress
    | CalibrationStored
    | UnixOffset
)
"""Type of the events that are recorded as JSON."""
EVENT_KINDS: dict[type, str] = {
    Tick: "tick",
    Configured: "configured",
    SourceOpened: "opened",
    SourceClosed: "closed",
    Request: "request",
    CalibrationSelected: "selected",
    JobFinished: "job",
    JobProgress: "progress",
    CalibrationStored: "stored",
    UnixOffset: "unix",
}
"""Name of each event type that is recorded as JSON. Chunks are recorded as bytes."""

_EVENTS: dict[str, Any] = {name: event for event, name in EVENT_KINDS.items()}
_FIELD_TYPES: dict[str, type[int | str]] = {
    "t_ns": int, "offset_ns": int, "source": str, "command": str, "transaction": str, "job": int,
    "reason": str, "text": str,
}  # fmt: skip
"""Expected types of the fields of events."""
_NOT_RECORDED = ("reply_to",)
"""Fields of events that are not recorded, because a replay does not need them."""
_OPTIONS = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_PASSTHROUGH_DATACLASS


class DamagedEventError(ValueError):
    """The content of a message cannot be converted to an event."""


def encode_state(state: LimbState) -> bytes:
    """Return `state` as JSON. Floats keep all digits, so equal bytes mean equal states."""
    return orjson.dumps(state, _to_json)


def encode_json(output: object) -> bytes:
    """Return an output (a named tuple, a dataclass or a mapping) as JSON."""
    return orjson.dumps(output, _to_json, _OPTIONS)


def encode_event(event: UnchunkedEvent) -> bytes:
    """Return `event` as JSON; `decode_event` is the inverse."""
    content: dict[str, Any] = {}
    for field in fields(event):
        value = getattr(event, field.name)
        if field.name == "rig":
            content["table"], content["output_rate_hz"] = value.table, value.output_rate_hz
        elif field.name not in _NOT_RECORDED:
            content[field.name] = value
    return orjson.dumps(content, _to_json, _OPTIONS)


def decode_event(kind: str, data: bytes) -> UnchunkedEvent:
    """Return the event with the name `kind` and the JSON content `data`.

    Raises
    ------
    DamagedEventError
        The content cannot be converted to an event.
    ConfigError
        The rig of the recording cannot be loaded, for example because a driver is missing.
    """
    try:
        return _event(kind, orjson.loads(data))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        text = f"damaged event {kind!r}: {type(error).__name__}: {error}"
        raise DamagedEventError(text) from error


def _event(kind: str, given: dict[str, Any]) -> UnchunkedEvent:
    for key, expected in _FIELD_TYPES.items():
        if not isinstance(given.get(key, expected()), expected):
            raise TypeError(f"{key} is {given[key]!r}, expected {expected.__name__}")

    if kind == "configured":
        rig = parse_rig(given.pop("table"), source="recording")
        rate_hz = float(given.pop("output_rate_hz", rig.output_rate_hz))
        given["rig"] = replace(rig, output_rate_hz=rate_hz)
        stored = given["calibration"]
        given["calibration"] = None if stored is None else Calibration.from_dict(stored)
    if kind == "selected":
        given["calibration"] = Calibration.from_dict(given["calibration"])
        given["request"] = Request(**given["request"])
    if kind == "job" and given["result"] is not None:
        given["result"] = FitResult.from_dict(given["result"])

    if kind not in _EVENTS:
        raise ValueError(f"unknown event {kind!r}")
    event: UnchunkedEvent = _EVENTS[kind](**given)
    return event


def _to_json(value: object) -> object:
    # Named tuples are converted first, because orjson does not support them. A limb state contains
    # ten named tuples.
    if isinstance(value, tuple):
        names: tuple[str, ...] | None = getattr(value, "_fields", None)
        return list(value) if names is None else dict(zip(names, value, strict=True))
    if isinstance(value, Calibration | FitResult):
        return value.to_dict()
    if hasattr(value, "items"):
        return dict(value.items())
    if is_dataclass(value):
        found = cast("DataclassInstance", value)
        return {
            field.name: getattr(found, field.name)
            for field in fields(found)
            if field.name not in _NOT_RECORDED
        }
    if isinstance(value, bytes):
        return value.hex()
    raise TypeError(f"not a value of a recording: {type(value).__name__}")
