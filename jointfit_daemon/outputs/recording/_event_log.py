"""Event log: all inputs of the core, one JSON object per line, sufficient for a replay.

Invariant: a replay of the events reproduces the limb states of the live run byte for byte; the
states are logged, too, for comparison. A log has no gaps: if memory or disk are exhausted, logging
ends with an error message, and the daemon continues.

The first key of a line is ``log`` (header), ``state`` (a limb state, output of the core) or ``e``
(name of an input event).
"""

from __future__ import annotations

import asyncio
import logging
import time
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import orjson

from jointfit_daemon import __version__
from jointfit_daemon.calibration import FitResult
from jointfit_daemon.config import parse_rig
from jointfit_daemon.limb_model import Calibration
from jointfit_daemon.model import Chunk, JointState, LimbState, SegmentState
from jointfit_daemon.pipeline.events import (
    CalibrationSelected,
    CalibrationStored,
    ChunkArrived,
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
    from collections.abc import Iterator
    from pathlib import Path

    from jointfit_daemon.pipeline.events import Event, Output

log = logging.getLogger(__name__)

FORMAT = 1
"""Version of the file format."""
FLUSH_S = 0.5
"""Interval between writes to the file, s."""
PENDING_BYTES = 64 * 1024 * 1024
"""Largest backlog of a slow disk, bytes: minutes of four IMUs and a motion capture system."""

_STATE = b'{"state":'
_NAMED = (LimbState, SegmentState, JointState)
"""Named tuples that are written as objects with field names."""


def encode_state(state: LimbState) -> bytes:
    """Return `state` as JSON. Floats round-trip, so equal bytes mean equal states."""
    return orjson.dumps(state, _to_json)


def encode_event(event: Event) -> bytes:
    """Return the line of `event` without its line end; `decode_event` is the inverse."""
    if isinstance(event, ChunkArrived):
        chunk = event.chunk
        return orjson.dumps(
            {"e": "chunk", "source": event.source, "t_ns": chunk.t_ns, "hex": chunk.data.hex()}
        )

    line: dict[str, Any] = {"e": _NAMES[type(event)]}
    for field in fields(event):
        if field.name == "rig":
            rig = getattr(event, field.name)
            line["table"], line["output_rate_hz"] = rig.table, rig.output_rate_hz
        elif field.name == "request":
            line["request"] = _request_form(getattr(event, field.name))
        elif field.name not in _NOT_RECORDED:
            line[field.name] = getattr(event, field.name)
    return orjson.dumps(line, _to_json, _OPTIONS)


def _request_form(request: Request) -> dict[str, Any]:
    return {
        field.name: getattr(request, field.name)
        for field in fields(request)
        if field.name not in _NOT_RECORDED
    }


def decode_event(line: dict[str, Any]) -> Event:
    """Return the event that a parsed line describes.

    Raises
    ------
    ValueError
        The line describes no event.
    ConfigError
        The rig of the recording cannot be loaded (a driver is missing).
    """
    try:
        return _event(line)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"damaged event: {type(error).__name__}: {error}") from error


def _event(line: dict[str, Any]) -> Event:
    given = dict(line)
    kind = given.pop("e", None)
    for key, expected in _FIELD_TYPES.items():
        if not isinstance(given.get(key, expected()), expected):
            raise TypeError(f"{key} is {given[key]!r}, expected {expected.__name__}")

    if kind == "chunk":
        return ChunkArrived(given["source"], Chunk(given["t_ns"], bytes.fromhex(given["hex"])))
    if kind == "configured":
        rig = parse_rig(given.pop("table"), source="event log")
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
        raise ValueError(f"unknown event: {kind!r}")
    event: Event = _EVENTS[kind](**given)
    return event


_FIELD_TYPES: dict[str, type[int | str]] = {
    "t_ns": int, "offset_ns": int, "source": str, "hex": str, "command": str, "transaction": str,
    "job": int, "reason": str, "text": str,
}  # fmt: skip
"""Expected types of the fields of events."""
_EVENTS: dict[str, Any] = {
    "tick": Tick,
    "configured": Configured,
    "opened": SourceOpened,
    "closed": SourceClosed,
    "request": Request,
    "selected": CalibrationSelected,
    "job": JobFinished,
    "progress": JobProgress,
    "stored": CalibrationStored,
    "unix": UnixOffset,
}
_NAMES = {event: name for name, event in _EVENTS.items()}
_NOT_RECORDED = ("reply_to",)
"""Fields of events that a replay does not need."""
_OPTIONS = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_PASSTHROUGH_DATACLASS


def _to_json(value: object) -> object:
    if isinstance(value, Calibration | FitResult):
        return value.to_dict()
    if isinstance(value, _NAMED):
        return value._asdict()
    if isinstance(value, tuple):  # orjson does not write named tuples
        return list(value)
    if hasattr(value, "items"):
        return dict(value.items())
    raise TypeError(f"not a value of the event log: {type(value).__name__}")


def read_events(path: Path) -> Iterator[Event]:
    """Yield the events of a log in order; an incomplete last line (after a crash) is skipped.

    Raises
    ------
    ValueError
        The file is not an event log, has another format version, or is damaged before its end.
    """
    for line in _lines(path):
        if not line.startswith(_STATE):
            yield decode_event(orjson.loads(line))


def read_states(path: Path) -> Iterator[bytes]:
    """Yield the limb states of a log, as written by `encode_state`."""
    for line in _lines(path):
        if line.startswith(_STATE):
            yield line[len(_STATE) : -1]


def _lines(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        header = file.readline()
        try:
            found = orjson.loads(header)["log"]
        except (orjson.JSONDecodeError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: not an event log") from error
        if found != FORMAT:
            raise ValueError(f"{path}: event log of format {found}, expected format {FORMAT}")

        for line in file:
            if line.endswith(b"\n"):
                yield line[:-1]


@dataclass(frozen=True, slots=True)
class RecordingHealth:
    """State of a recording."""

    file: str
    written_bytes: int
    backlog_bytes: int
    """Lines not yet written."""
    failure: str | None
    """Reason for which logging ended early; None while it works."""


class EventLogWriter:
    """Writes events and limb states to a new file, within half a second; a `Sink` of the core.

    Parameters
    ----------
    directory
        Folder of the file; created if absent.
    name
        Beginning of the file name; the time follows.

    Raises
    ------
    OSError
        The file cannot be created.
    """

    def __init__(self, directory: Path, name: str) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        now = datetime.now(tz=UTC)
        self.path = directory / f"{name}-{now:%Y%m%dT%H%M%S.%f}.events.jsonl"
        self._file = self.path.open("xb", buffering=0)
        self._pending: list[bytes] = []
        self._bytes = 0
        self.written_bytes = 0
        self.failure: str | None = None
        """Reason for which logging ended early; None while it works."""
        header = {"log": FORMAT, "version": __version__, "unix_ns": time.time_ns()}
        self._add(orjson.dumps(header))

    def event(self, event: Event) -> None:
        """Log one input event."""
        if self.failure is None:
            self._add(encode_event(event))

    def output(self, output: Output) -> None:
        """Log one output if it is a limb state."""
        if isinstance(output, LimbState) and self.failure is None:
            self._add(b"".join((_STATE, encode_state(output), b"}")))

    def health(self) -> RecordingHealth:
        """Return the state of the recording."""
        return RecordingHealth(self.path.name, self.written_bytes, self._bytes, self.failure)

    def _add(self, line: bytes) -> None:
        if self._bytes > PENDING_BYTES:
            self._fail(f"the disk is too slow: backlog of {self._bytes} bytes")
            return
        self._pending.append(line)
        self._bytes += len(line) + 1

    async def run(self) -> None:
        """Write pending lines twice per second until cancelled; then write the rest and close."""
        try:
            while self.failure is None:
                await asyncio.sleep(FLUSH_S)
                writing = asyncio.create_task(
                    asyncio.to_thread(self._write, self._take_pending()), name="recording writer"
                )
                try:
                    await asyncio.shield(writing)
                finally:  # a thread cannot be cancelled; later lines must follow it
                    await asyncio.wait([writing])
        finally:
            self.close()

    def close(self) -> None:
        """Write pending lines and close the file."""
        if not self._file.closed:
            if self.failure is None:
                self._write(self._take_pending())
            self._file.close()

    def _take_pending(self) -> bytes:
        lines, self._pending, self._bytes = self._pending, [], 0
        return b"".join([line + b"\n" for line in lines])

    def _write(self, data: bytes) -> None:
        view = memoryview(data)
        try:
            while view:
                view = view[self._file.write(view) :]
        except OSError as error:
            self._fail(f"{self.path}: {error.strerror}")
        self.written_bytes += len(data) - len(view)

    def _fail(self, reason: str) -> None:
        self.failure, self._pending, self._bytes = reason, [], 0
        log.error("event log ended early: %s", reason)
