"""The recorder: a sink of the core that passes events and outputs to a thread.

Invariant: `event` and `output` append to a list of limited size and return. Messages that exceed
the limit are counted, and the recording contains a gap in their place.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_daemon.model import LimbState
from jointfit_daemon.outputs.recording._channels import OUTPUT_KINDS
from jointfit_daemon.outputs.recording._description import RecordingGap
from jointfit_daemon.outputs.recording._part_file import UNFINISHED
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
    from collections.abc import Callable
    from pathlib import Path

    from jointfit_daemon.pipeline.events import Event, Output

FLUSH_S = 0.5
"""Interval between writes to the file, s: a power cut loses at most twice as much."""
PENDING_BYTES = 16 * 1024 * 1024
"""Largest memory of messages that wait for a slow disk, bytes: ten seconds of four IMUs."""
_MESSAGE_BYTES: dict[type, int] = {LimbState: 6000}
"""Memory of messages by their type, bytes."""
_OTHER_BYTES = 500
"""Memory of any other message, bytes; the data of a chunk are added."""


@dataclass(frozen=True, slots=True)
class RecordingHealth:
    """State of a recording."""

    file: str
    """Name of the open file; empty before the first one."""
    written_bytes: int
    backlog_bytes: int
    """Memory of messages that are not yet written."""
    lost: int
    """Messages that the disk did not take."""
    failure: str | None
    """Reason for which messages are not written at present; None while they are."""


class Recorder:
    """Records events and outputs; a `Sink` of the core.

    Parameters
    ----------
    directory
        Folder of the files; created if absent.
    name
        Beginning of the file names; the time follows.
    limits
        When a file ends and the next one begins.
    report
        Receives each interruption and resumption.
    """

    def __init__(
        self,
        directory: Path,
        name: str,
        limits: RecordingLimits | None = None,
        report: Callable[[RecordingReport], None] = lambda _: None,
    ) -> None:
        self._writer = SessionWriter(
            directory, name, began_with_daemon=True, limits=limits or RecordingLimits()
        )
        self._report = report
        self._snapshot = self._before = Snapshot()
        self._pending: list[object] = []
        self._pending_bytes = 0
        self._first_sequence = 0
        self._lost = 0
        self._gap: RecordingGap | None = None
        self._t_ns = time.monotonic_ns()

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
        """Record one output, if it is of a recorded kind."""
        kind = type(output)
        if kind in OUTPUT_KINDS:
            self._add(output, _MESSAGE_BYTES.get(kind, _OTHER_BYTES))
        elif isinstance(output, CalibrationReady):
            self._snapshot = self._snapshot.after_output(output, self._t_ns)

    def daemon_message(self, channel: str, content: object) -> None:
        """Record a message of the daemon around the core."""
        self._add(DaemonMessage(channel, time.monotonic_ns(), content), _OTHER_BYTES)

    def _add(self, message: object, size_bytes: int) -> None:
        if self._pending_bytes > PENDING_BYTES:
            self._lost += 1
        else:
            self._pending.append(message)
            self._pending_bytes += size_bytes

    def health(self) -> RecordingHealth:
        """Return the state of the recording."""
        writer = self._writer
        return RecordingHealth(
            "" if writer.file is None else writer.file.name.removesuffix(UNFINISHED),
            writer.written_bytes,
            self._pending_bytes + writer.unwritten_bytes,
            writer.lost + self._lost,
            writer.fault,
        )

    @property
    def path(self) -> Path | None:
        """The open file; None before the first write and after the last one."""
        return self._writer.file

    async def run(self) -> None:
        """Write twice per second until cancelled; then write the rest and close the file."""
        try:
            while True:
                writing = asyncio.create_task(
                    asyncio.to_thread(self._writer.write, self._take()), name="recording writer"
                )
                try:
                    await asyncio.shield(writing)
                finally:  # a thread cannot be cancelled; later messages must follow it
                    await asyncio.wait([writing])
                self._pass_reports()
                await asyncio.sleep(FLUSH_S)
        finally:
            self.close()

    def close(self) -> None:
        """Write the rest and close the file."""
        batch = self._take()
        self._writer.pause_s = 0.0
        self._writer.write(batch)
        self._writer.close(batch.next_sequence)
        self._pass_reports()

    def _take(self) -> Batch:
        """Return the messages that wait, and begin to collect again."""
        messages, before, gap = self._pending, self._before, self._gap
        self._pending, self._pending_bytes, self._before = [], 0, self._snapshot
        batch = Batch(self._first_sequence, messages, before, self._snapshot, gap)
        self._first_sequence = batch.next_sequence

        # Messages that exceeded the limit follow this batch, and precede the next one.
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

    def _pass_reports(self) -> None:
        reports, self._writer.reports = self._writer.reports, []
        for report in reports:
            self._report(report)
