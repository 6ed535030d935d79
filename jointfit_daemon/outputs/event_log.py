"""The log of everything that went into the core: one JSON object a line.

Law: exact. Floats keep their shortest repr, bytes are hexadecimal, so that `read_events` gives
equal events and a replay gives the same limb states. States are written beside the events, as
they were emitted, so that a replay can be compared byte for byte.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import orjson

from jointfit_daemon.calibration.result import Calibration
from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import Chunk
from jointfit_daemon.pipeline import events as e

if TYPE_CHECKING:
    from collections.abc import Iterator
    from io import BufferedWriter
    from pathlib import Path

    from jointfit_daemon.model import LimbState

FLUSH_NS = 1_000_000_000
"""What a power cut may take."""


def encode_state(state: LimbState) -> bytes:
    """Return a limb state as bytes that differ whenever any of its numbers does."""
    return orjson.dumps(state)


def encode_event(event: e.Event) -> bytes:
    """Return one event as a JSON line, without its end."""
    kind = type(event).__name__
    if isinstance(event, e.ChunkArrived):
        chunk = event.chunk
        return orjson.dumps(
            {"event": kind, "source": event.source, "t_ns": chunk.t_ns, "data": chunk.data.hex()}
        )
    if isinstance(event, e.Configured):
        calibration = event.calibration
        row = {
            "event": kind,
            "t_ns": event.t_ns,
            "rig": event.rig.table,
            "calibration": None if calibration is None else calibration.to_dict(),
            "calibration_version": event.calibration_version,
        }
        return orjson.dumps(row, default=_plain)
    fields = {name: getattr(event, name) for name in event.__dataclass_fields__}
    return orjson.dumps({"event": kind, **fields}, default=_plain)


def _plain(value: object) -> object:
    """Return mappings and tuples of foreign kinds as what JSON knows."""
    if hasattr(value, "items"):
        return dict(value.items())
    raise TypeError


def decode_event(row: dict[str, Any]) -> e.Event:
    """Return the event of one line."""
    kind = row.pop("event")
    if kind == "ChunkArrived":
        return e.ChunkArrived(row["source"], Chunk(row["t_ns"], bytes.fromhex(row["data"])))
    if kind == "Configured":
        stored = row["calibration"]
        calibration = None if stored is None else Calibration.from_dict(stored)
        version = row["calibration_version"]
        return e.Configured(row["t_ns"], parse_rig(row["rig"]), calibration, version)
    event: e.Event = _KINDS[kind](**row)
    return event


_KINDS: dict[str, Any] = {
    cls.__name__: cls
    for cls in (
        e.SourceOpened,
        e.SourceClosed,
        e.Tick,
        e.Request,
        e.JobFinished,
        e.CalibrationStored,
    )
}


class EventLog:
    """Appends events and states to a file; flushed at least once a second of events.

    Parameters
    ----------
    path : Path
        Made anew; its folder too.

    Raises
    ------
    OSError
        The file cannot be made or written: the caller stops logging and goes on.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.bytes_written = 0
        self._file: BufferedWriter = path.open("xb")
        self._flushed_ns = 0

    def event(self, event: e.Event) -> None:
        """Write one event, before the core takes it."""
        self._write(encode_event(event))
        t_ns = event.chunk.t_ns if isinstance(event, e.ChunkArrived) else event.t_ns
        if t_ns - self._flushed_ns >= FLUSH_NS:
            self._flushed_ns = t_ns
            self._file.flush()

    def state(self, state: LimbState) -> None:
        """Write one emitted state."""
        self._write(b'{"state":' + encode_state(state) + b"}")

    def close(self) -> None:
        """Flush and close."""
        self._file.close()

    def _write(self, line: bytes) -> None:
        self.bytes_written += self._file.write(line + b"\n")


def read_events(path: Path) -> Iterator[e.Event]:
    """Yield the events of a log; a line cut short by a power cut ends it."""
    for row in _rows(path):
        if "event" in row:
            yield decode_event(row)


def read_states(path: Path) -> Iterator[bytes]:
    """Yield the states of a log, byte for byte as they were encoded when emitted."""
    with path.open("rb") as log:
        for line in log:
            if line.startswith(b'{"state":') and line.endswith(b"}\n"):
                yield line[len(b'{"state":') : -2]


def _rows(path: Path) -> Iterator[dict[str, Any]]:
    with path.open("rb") as log:
        for line in log:
            try:
                yield orjson.loads(line)
            except orjson.JSONDecodeError:
                return
