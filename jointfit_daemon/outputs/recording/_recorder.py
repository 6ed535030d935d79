"""The recorder: a sink of the core that passes events and outputs to a writing thread.

Invariant: `event` and `output` append to a list of limited size and return. Messages that exceed
the limit are counted, and the recording contains a gap instead of them.
"""

from __future__ import annotations

import asyncio
import shutil
import threading
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from jointfit_daemon.model import LimbState
from jointfit_daemon.outputs.recording._channels import OUTPUT_KINDS
from jointfit_daemon.outputs.recording._description import RecordingGap
from jointfit_daemon.outputs.recording._part_file import UNFINISHED
from jointfit_daemon.outputs.recording._repair import repair_unfinished
from jointfit_daemon.outputs.recording._session_writer import (
    Batch,
    DaemonMessage,
    RecordingLimits,
    RecordingReport,
    SessionWriter,
)
from jointfit_daemon.outputs.recording._snapshot import SNAPSHOT_TYPES, Snapshot
from jointfit_daemon.pipeline.events import CalibrationReady, ChunkArrived, NoticeLevel

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from jointfit_daemon.pipeline.events import Event, Output

FLUSH_S = 0.3
"""Interval between the starts of two writes, s. If the daemon is killed, the messages of this
interval and of the duration of two writes can be lost."""
_SHORTEST_PAUSE_S = 0.02
"""Shortest pause between two writes, s; it applies to slow disks."""
PENDING_BYTES = 16 * 1024 * 1024
"""Largest memory for messages that wait for a slow disk, bytes. The messages of four IMUs at
100 Hz fill it in about 20 s."""
_MESSAGE_BYTES: dict[type, int] = {LimbState: 6000}
"""Memory that a message occupies, by its type, bytes."""
_OTHER_BYTES = 500
"""Memory that any other message occupies, bytes, without the data of a chunk."""
_FREE_S = 5.0
"""Interval between measurements of the free disk space, s."""


@dataclass(frozen=True, slots=True)
class RecordingHealth:
    """State of the current recording, or of the last recording if none is running."""

    file: str = ""
    """Name of the open file, or of the last file if none is open; empty if there was none."""
    duration_s: float = 0.0
    """Time from the start of the recording to now or to its end, s."""
    written_bytes: int = 0
    backlog_bytes: int = 0
    """Memory of the messages that are not written yet, bytes."""
    lost: int = 0
    """Number of messages that could not be written."""
    failure: str | None = None
    """Reason why messages cannot be written at present; None if there is no fault."""
    free_bytes: int | None = None
    """Free disk space for recordings, bytes; None while unknown."""
    active: bool = False
    """Whether a recording is running."""


class Recorder:
    """Records events and outputs between `begin` and `stop`; a `Sink` of the core.

    Parameters
    ----------
    directory
        Folder for the files, which is created if necessary.
    name
        Beginning of the file names; the time follows it.
    limits
        Limits at which a file ends and at which old files are deleted.
    report
        Function that is called with each change to report, such as an interruption of writing.
    autostart
        Whether recording starts with the first event.
    describe
        Function that returns, for each open source, the chunks that a new decoder needs before all
        others.
    """

    def __init__(
        self,
        directory: Path,
        name: str,
        limits: RecordingLimits | None = None,
        report: Callable[[RecordingReport], None] = lambda _: None,
        *,
        autostart: bool = True,
        describe: Callable[[], Mapping[str, tuple[bytes, ...]]] = dict,
    ) -> None:
        self._directory, self._name, self._describe = directory, name, describe
        self._limits = limits or RecordingLimits()
        self._report = report
        self._writing = asyncio.Lock()
        """Lock that permits one call at a time in the writing thread."""
        self._changing = asyncio.Lock()
        """Lock around starts and stops, so that each answer describes the state after its own
        request."""
        self._writer: SessionWriter | None = None
        self._snapshot = self._before = Snapshot()
        self._t_ns = time.monotonic_ns()
        self._began_s = 0.0
        self._free_bytes: int | None = None
        self._last = RecordingHealth()
        self._clear()
        if autostart:
            self.begin(with_daemon=True)

    def _clear(self) -> None:
        self._pending: list[object] = []
        self._pending_bytes = 0
        self._first_sequence = 0
        self._lost = 0
        self._gap: RecordingGap | None = None

    def begin(self, *, with_daemon: bool = False) -> SessionWriter:
        """Start recording and return the writer. The next write creates the file."""
        self._clear()
        self._before = replace(self._snapshot, descriptions=self._describe())
        self._began_s = time.monotonic()
        writer = SessionWriter(self._directory, self._name, with_daemon, self._limits)
        self._writer = writer
        return writer

    # --- messages ----------------------------------------------------------------------------

    def event(self, event: Event) -> None:
        """Record one input event."""
        if isinstance(event, ChunkArrived):
            self._t_ns = event.chunk.t_ns
            self._add(event, _OTHER_BYTES + len(event.chunk.data))
            return
        self._t_ns = event.t_ns
        self._add(event, _OTHER_BYTES)
        if isinstance(event, SNAPSHOT_TYPES):
            self._snapshot = self._snapshot.after_event(event)

    def output(self, output: Output) -> None:
        """Record one output if its type is recorded."""
        kind = type(output)
        if kind in OUTPUT_KINDS:
            self._add(output, _MESSAGE_BYTES.get(kind, _OTHER_BYTES))
        elif isinstance(output, CalibrationReady):
            self._snapshot = self._snapshot.after_output(output, self._t_ns)

    def daemon_message(self, channel: str, content: object) -> None:
        """Record a message of the daemon outside the core."""
        self._add(DaemonMessage(channel, time.monotonic_ns(), content), _OTHER_BYTES)

    def _add(self, message: object, size_bytes: int) -> None:
        if self._writer is None:
            return
        if self._pending_bytes > PENDING_BYTES:
            self._lost += 1
        else:
            self._pending.append(message)
            self._pending_bytes += size_bytes

    # --- state -------------------------------------------------------------------------------

    def health(self) -> RecordingHealth:
        """Return the state of the running recording; without one, of the last recording."""
        if self._writer is None:
            return replace(self._last, free_bytes=self._free_bytes)
        return self._health(self._writer)

    def _health(self, writer: SessionWriter) -> RecordingHealth:
        return RecordingHealth(
            "" if writer.file is None else writer.file.name.removesuffix(UNFINISHED),
            time.monotonic() - self._began_s,
            writer.written_bytes,
            self._pending_bytes + writer.unwritten_bytes,
            writer.lost + self._lost + (0 if self._gap is None else self._gap.count),
            writer.fault,
            self._free_bytes,
            active=True,
        )

    @property
    def directory(self) -> Path:
        """Folder that contains the files."""
        return self._directory

    @property
    def path(self) -> Path | None:
        """Path of the open file; None before the first write and after the last write."""
        return None if self._writer is None else self._writer.file

    # --- writing -----------------------------------------------------------------------------

    async def start(self) -> RecordingHealth:
        """Start recording and return when the file exists; do nothing if a recording is running.

        Raises
        ------
        OSError
            The file cannot be created, so nothing is recorded.
        """
        async with self._changing:
            writer = self._writer
            if writer is None:
                writer = self.begin()
                await self._write()
                if writer.file is None and writer.fault is not None:
                    self._writer = None
                    raise OSError(writer.fault)
                self._report(RecordingReport(f"recording started: {self._health(writer).file}"))
            return self._health(writer)

    async def stop(self) -> RecordingHealth:
        """Write all messages and close the file, if one is open; return the last state."""
        async with self._changing, self._writing:
            writer = self._writer
            if writer is not None:
                self._last, rest = replace(self._health(writer), active=False), self._take_rest()
                self._writer = None
                self._clear()
                await _in_thread(lambda: _close(writer, rest))
                self._pass_reports(writer)
                self._last = replace(
                    self._last,
                    written_bytes=writer.written_bytes,
                    backlog_bytes=0,
                    lost=writer.lost,
                    failure=writer.fault,
                )
                size_mb = writer.written_bytes / 1e6
                text = f"recording stopped: {self._last.file}, {size_mb:.1f} MB"
                self._report(RecordingReport(text))
        return self.health()

    async def run(self) -> None:
        """Write every 0.3 s until cancelled, then write the rest and close the file.

        Unfinished files of earlier runs are repaired at the same time.
        """
        stopped = threading.Event()
        repair = asyncio.create_task(self._repair(stopped), name="recording repair")
        measure_s = 0.0
        try:
            while True:
                began_s = time.monotonic()
                await self._write()
                if began_s >= measure_s:
                    measure_s = began_s + _FREE_S
                    await _in_thread(self._measure_free_space)
                took_s = time.monotonic() - began_s
                await asyncio.sleep(max(_SHORTEST_PAUSE_S, FLUSH_S - took_s))
        finally:
            stopped.set()
            repair.cancel()
            self.close()

    def _measure_free_space(self) -> None:
        # The folder may not exist, because the first recording creates it.
        places = (self._directory, *self._directory.parents)
        try:
            place = next(place for place in places if place.exists())
            self._free_bytes = shutil.disk_usage(place).free
        except OSError:
            self._free_bytes = None

    async def _repair(self, stopped: threading.Event) -> None:
        found = await asyncio.to_thread(
            repair_unfinished, self._directory, self._name, stopped.is_set
        )
        for result in found:
            if isinstance(result, str):
                self._report(RecordingReport(result, NoticeLevel.WARNING))
            else:
                text = f"{result.path.name}: unfinished recording of an earlier run repaired"
                texts = [text, *(gap.text() for gap in result.gaps)]
                self._report(RecordingReport("; ".join(texts)))

    async def _write(self) -> None:
        async with self._writing:
            writer = self._writer
            if writer is not None:
                batch = self._take()
                await _in_thread(lambda: writer.write(batch))
                self._pass_reports(writer)

    def close(self) -> None:
        """Write the rest and close the file in the calling thread."""
        writer, self._writer = self._writer, None
        if writer is not None:
            _close(writer, self._take_rest())
            self._pass_reports(writer)

    def _take_rest(self) -> list[Batch]:
        """Return the waiting messages, and the gap after them if there is one."""
        rest = [self._take()]
        return rest if self._gap is None else [*rest, self._take()]

    def _take(self) -> Batch:
        """Return the waiting messages, and begin to collect again."""
        messages, before, gap = self._pending, self._before, self._gap
        self._pending, self._pending_bytes = [], 0
        self._before = replace(self._snapshot, descriptions=self._describe())
        batch = Batch(self._first_sequence, messages, before, self._snapshot, gap)
        self._first_sequence = batch.next_sequence

        # Messages that exceeded the limit belong between this batch and the next batch.
        self._gap = None
        if self._lost:
            now_ns = time.monotonic_ns()
            self._gap = RecordingGap(
                self._first_sequence, self._lost, self._t_ns, now_ns, "the disk is too slow"
            )
            self._first_sequence += self._lost
            text = f"{self._lost} messages were lost: the disk is too slow"
            self._report(RecordingReport(text, NoticeLevel.WARNING))
            self._lost = 0
        return batch

    def _pass_reports(self, writer: SessionWriter) -> None:
        reports, writer.reports = writer.reports, []
        for report in reports:
            self._report(report)


def _close(writer: SessionWriter, rest: list[Batch]) -> None:
    writer.pause_s = 0.0
    for batch in rest:
        writer.write(batch)
    writer.close(rest[-1].next_sequence)


async def _in_thread(work: Callable[[], None]) -> None:
    """Run `work` in a thread. A cancellation takes effect after the end of `work`.

    A thread cannot be stopped, and later work must not overlap with it.
    """
    running = asyncio.create_task(asyncio.to_thread(work), name="recording writer")
    try:
        await asyncio.shield(running)
    finally:
        await asyncio.wait([running])
