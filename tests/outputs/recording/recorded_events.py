"""Functions that write events to a recording with the recorder, and read them from it."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from jointfit_daemon.outputs.recording import Recorder, read_events

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.pipeline.events import Event

BATCH = 500
"""Number of events that are written at once."""


def write_recording(directory: Path, events: Iterable[Event], name: str = "rig") -> Path:
    """Write `events` to a recording in `directory`, and return its only file."""
    recorder = Recorder(directory, name)
    writer = recorder._writer
    assert writer is not None
    writer.pause_s = 0.0
    for number, event in enumerate(events, 1):
        recorder.event(event)
        if number % BATCH == 0:
            writer.write(recorder._take())
    recorder.close()
    (path,) = directory.glob(f"{name}-*.mcap")
    return path


def after_recording(events: Iterable[Event]) -> list[Event]:
    """Return `events` as read from a recording of them."""
    with TemporaryDirectory() as directory:
        return list(read_events(write_recording(Path(directory), events)))
