"""A log of everything that went into the core: one JSON object a line, enough for a replay.

Law: a replay of the events gives the limb states of the live run byte for byte, so the states are
logged beside them. A log with a hole in it would lie: where memory or disk give out, logging ends
and says so; the daemon goes on.

Line kinds, by their first key: ``log`` (header), ``state`` (a limb state that came out), else
``e`` names the event that went in.
"""

from __future__ import annotations

import asyncio
import logging
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import orjson

from jointfit_daemon import __version__
from jointfit_daemon.config import parse_rig
from jointfit_daemon.limb_model import Calibration
from jointfit_daemon.model import Chunk, JointState, LimbState, SegmentState
from jointfit_daemon.pipeline.events import (
    CalibrationStored,
    ChunkArrived,
    Configured,
    JobFinished,
    Request,
    SourceClosed,
    SourceOpened,
    Tick,
    UnixOffset,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from jointfit_daemon.pipeline.events import Event

log = logging.getLogger(__name__)

FORMAT = 1
FLUSH_S = 0.5
PENDING_BYTES = 64 * 1024 * 1024
"""What may wait for a slow disk: minutes of four IMUs and a mocap system."""

_STATE = b'{"state":'
_NAMED = (LimbState, SegmentState, JointState)
"""What is written with the names of its fields."""


def encode_state(state: LimbState) -> bytes:
    """Return `state` exactly, as JSON: floats round-trip, so equal bytes are equal states."""
    return orjson.dumps(state, _exact)


def encode_event(event: Event) -> bytes:
    """Return one line, without its end, from which ``decode_event`` gives an equal event."""
    if isinstance(event, ChunkArrived):
        chunk = event.chunk
        return orjson.dumps(
            {"e": "chunk", "source": event.source, "t_ns": chunk.t_ns, "hex": chunk.data.hex()}
        )
    return orjson.dumps(_described(event), _exact, orjson.OPT_SERIALIZE_NUMPY)


def _described(event: Event) -> dict[str, Any]:  # noqa: PLR0911 - one return a kind
    match event:
        case Tick(t_ns):
            return {"e": "tick", "t_ns": t_ns}
        case Configured(t_ns, rig, calibration, version, age_s):
            stored = None if calibration is None else calibration.to_dict()
            return {"e": "configured", "t_ns": t_ns, "table": rig.table} | {
                "calibration": stored,
                "calibration_version": version,
                "calibration_age_s": age_s,
            }
        case SourceOpened(t_ns, source):
            return {"e": "opened", "t_ns": t_ns, "source": source}
        case SourceClosed(t_ns, source, reason, text):
            return {"e": "closed", "t_ns": t_ns, "source": source, "reason": reason, "text": text}
        case Request(t_ns, command, transaction, arguments):
            return {"e": "request", "t_ns": t_ns, "command": command} | {
                "transaction": transaction,
                "arguments": arguments,
            }
        case JobFinished(t_ns, job, result, error):
            return {"e": "job", "t_ns": t_ns, "job": job, "result": result, "error": error}
        case CalibrationStored(t_ns, version):
            return {"e": "stored", "t_ns": t_ns, "version": version}
        case UnixOffset(t_ns, offset_ns):
            return {"e": "unix", "t_ns": t_ns, "offset_ns": offset_ns}
    raise TypeError(f"no such event: {event!r}")


def decode_event(line: dict[str, Any]) -> Event:
    """Return the event that a parsed line describes.

    Raises
    ------
    ValueError
        The line describes none.
    ConfigError
        The rig it was recorded with does not load here (a driver is missing).
    """
    try:
        return _decoded(line)
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"damaged event: {type(error).__name__}: {error}") from error


def _decoded(line: dict[str, Any]) -> Event:
    given = dict(line)
    kind = given.pop("e", None)
    for key, expected in _FIELD_TYPES.items():
        if not isinstance(given.get(key, expected()), expected):
            raise TypeError(f"{key} is {given[key]!r}, expected {expected.__name__}")
    if kind == "chunk":
        return ChunkArrived(given["source"], Chunk(given["t_ns"], bytes.fromhex(given["hex"])))
    if kind == "configured":
        given["rig"] = parse_rig(given.pop("table"), source="event log")
        stored = given["calibration"]
        given["calibration"] = None if stored is None else Calibration.from_dict(stored)
    if kind not in _KINDS:
        raise ValueError(f"no such event: {kind!r}")
    event: Event = _KINDS[kind](**given)
    return event


_FIELD_TYPES: dict[str, type[int | str]] = {
    "t_ns": int, "offset_ns": int, "source": str, "hex": str, "command": str, "transaction": str,
    "job": int, "reason": str, "text": str,
}  # fmt: skip
"""Types of the fields that every event of a kind has."""
_KINDS: dict[str, Any] = {
    "tick": Tick,
    "configured": Configured,
    "opened": SourceOpened,
    "closed": SourceClosed,
    "request": Request,
    "job": JobFinished,
    "stored": CalibrationStored,
    "unix": UnixOffset,
}


def _exact(value: object) -> object:
    if isinstance(value, _NAMED):
        return value._asdict()
    if isinstance(value, tuple):  # named tuples; orjson writes only plain ones
        return list(value)
    if hasattr(value, "items"):
        return dict(value.items())
    raise TypeError(f"not a value of the event log: {type(value).__name__}")


# --- reading ----------------------------------------------------------------------------------


def read_events(path: Path) -> Iterator[Event]:
    """Yield the events of a log in order; a last line cut short by a crash is left out.

    Raises
    ------
    ValueError
        The file is no event log, of another format, or damaged before its end.
    """
    for line in _lines(path):
        if not line.startswith(_STATE):
            yield decode_event(orjson.loads(line))


def read_states(path: Path) -> Iterator[bytes]:
    """Yield the limb states of a log as ``encode_state`` wrote them."""
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
            raise ValueError(f"{path}: event log of format {found}, this program reads {FORMAT}")
        for line in file:
            if line.endswith(b"\n"):
                yield line[:-1]


# --- writing ----------------------------------------------------------------------------------


class EventLogWriter:
    """Writes events and states to a new file in `directory`, at the latest half a second later.

    Parameters
    ----------
    directory
        Made when absent.
    name
        Begins the file's name; the rest is the time.

    Raises
    ------
    OSError
        The file cannot be made.
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
        """Why logging ended early."""
        header = {"log": FORMAT, "version": __version__, "unix_ns": time.time_ns()}
        self._add(orjson.dumps(header))

    def event(self, event: Event) -> None:
        """Take one event."""
        if self.failure is None:
            self._add(encode_event(event))

    def state(self, state: LimbState) -> None:
        """Take one state."""
        if self.failure is None:
            self._add(b"".join((_STATE, encode_state(state), b"}")))

    def figures(self) -> dict[str, object]:
        """Return the recording's part of the health message."""
        return {
            "file": self.path.name,
            "written_bytes": self.written_bytes,
            "backlog_bytes": self._bytes,
            "failure": self.failure,
        }

    def _add(self, line: bytes) -> None:
        if self._bytes > PENDING_BYTES:
            self._fail(f"the disk is too slow: {self._bytes} bytes wait for it")
            return
        self._pending.append(line)
        self._bytes += len(line) + 1

    async def run(self) -> None:
        """Write what waits, twice a second, until cancelled; then write the rest and close."""
        try:
            while self.failure is None:
                await asyncio.sleep(FLUSH_S)
                writing = asyncio.create_task(
                    asyncio.to_thread(self._write, self._taken()), name="event log writer"
                )
                try:
                    await asyncio.shield(writing)
                finally:  # a thread cannot be cancelled; the rest must come after it
                    await asyncio.wait([writing])
        finally:
            self.close()

    def close(self) -> None:
        """Write what waits and close the file."""
        if not self._file.closed:
            if self.failure is None:
                self._write(self._taken())
            self._file.close()

    def _taken(self) -> bytes:
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

    def _fail(self, why: str) -> None:
        self.failure, self._pending, self._bytes = why, [], 0
        log.error("event log ended early: %s", why)
