"""Writer of the messages of one session to its files. Every method blocks, and runs in a thread.

Invariant: a failure of the disk raises no exception. Messages that cannot be written are counted,
and a gap is recorded as soon as writing works again.
"""

from __future__ import annotations

import errno
import sys
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, NamedTuple, cast
from uuid import uuid4

import orjson
from mcap.writer import LIBRARY_IDENTIFIER

from jointfit_daemon import __version__
from jointfit_daemon.model import LimbState
from jointfit_daemon.outputs.recording._channels import (
    EVENT_CHANNELS,
    FORMAT,
    GAP,
    OUTPUT_KINDS,
    SNAPSHOT,
    SOURCE,
    encode_output,
)
from jointfit_daemon.outputs.recording._description import RecordingGap, RecordingInfo
from jointfit_daemon.outputs.recording._event_json import EVENT_KINDS, encode_event, encode_json
from jointfit_daemon.outputs.recording._part_file import (
    PartFile,
    RecordedAttachment,
    sync_directory,
)
from jointfit_daemon.outputs.recording._retention import delete_oldest
from jointfit_daemon.pipeline.events import ChunkArrived, NoticeLevel

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from jointfit_daemon.outputs.recording._event_json import UnchunkedEvent
    from jointfit_daemon.outputs.recording._snapshot import Snapshot
    from jointfit_daemon.pipeline.events import Output

MOST_UNWRITTEN_BYTES = 16 * 1024 * 1024
"""Largest number of bytes that wait while the disk is full, equal to several minutes of data of
four IMUs. Later messages are lost."""
RETRY_S = 1.0
"""Interval between attempts to create a file, s."""
ABANDON_S = 5.0
"""Time after which an unwritable file is replaced by a new file, s. A file that has reached the
largest permitted size (EFBIG) is replaced at once."""
_FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors that end when files are deleted. With these errors the file is not replaced."""
_YIELD_MESSAGES, _YIELD_S = 32, 0.0005
"""Number of messages encoded at once, and the pause after them, s. With these pauses, the event
loop waits for the interpreter lock for less than half a millisecond."""
_LONGEST_PAUSED_S = 0.05
"""Time after which the rest of a batch is encoded without pauses, s. On a busy machine the pauses
take long, and unwritten messages are lost if the process is killed."""

PROGRAM = f"jointfitd {__version__}"
"""Name and version of this program."""
SOFTWARE = f"{PROGRAM}, {LIBRARY_IDENTIFIER}, Python {sys.version.split()[0]}"
"""Names and versions of the programs that write a recording."""


class DaemonMessage(NamedTuple):
    """A message of the daemon outside the core."""

    channel: str
    t_ns: int
    content: object


@dataclass(frozen=True, slots=True)
class Batch:
    """Consecutive messages that are written together."""

    first_sequence: int
    messages: Sequence[object]
    """Events, outputs and `DaemonMessage`."""
    before: Snapshot
    """State before the first message."""
    after: Snapshot
    """State after the last message."""
    gap: RecordingGap | None
    """Gap of lost messages immediately before the first message; None without a gap."""

    @property
    def next_sequence(self) -> int:
        """Sequence number after the last message."""
        return self.first_sequence + len(self.messages)


class RecordingReport(NamedTuple):
    """A change in the state of the recording that must be reported."""

    text: str
    level: NoticeLevel = NoticeLevel.INFO


@dataclass(frozen=True, slots=True)
class RecordingLimits:
    """Limits at which a file ends and at which the oldest files are deleted."""

    file_bytes: float = float("inf")
    file_s: float = float("inf")
    keep_bytes: float = float("inf")
    """Largest total size of the rig's recordings, bytes. Above it, the oldest complete files are
    deleted."""


@dataclass(slots=True)
class SessionWriter:
    """Writes the files of one session.

    Parameters
    ----------
    directory
        Folder for the files, which is created if necessary.
    rig
        Beginning of the file names.
    began_with_daemon
        Whether the first message is the first event of the daemon.
    limits
        Limits at which a file ends and the next file begins.
    pause_s
        Duration of the pause after every 32 messages, s.
    """

    directory: Path
    rig: str
    began_with_daemon: bool
    limits: RecordingLimits = field(default_factory=RecordingLimits)
    pause_s: float = _YIELD_S
    session: str = field(default_factory=lambda: uuid4().hex)
    fault: str | None = None
    """Reason why messages cannot be written at present; None if there is no fault."""
    lost: int = 0
    """Number of messages that could not be written."""
    written_bytes: int = 0
    """Total size of all finished files and the current file, bytes."""
    reports: list[RecordingReport] = field(default_factory=list)
    """Changes that are not reported yet. The owner of this object empties the list."""
    _part: PartFile | None = None
    _number: int = 0
    _stem: str = ""
    _gap: RecordingGap | None = None
    _saved_sequence: int = 0
    _added_sequence: int = 0
    _lost_before: int = 0
    _now_ns: int = 0
    _failed_s: float | None = None
    _retry_s: float = 0.0
    _opened_s: float = 0.0
    _finished_bytes: int = 0

    @property
    def file(self) -> Path | None:
        """Path of the open file; None if no file is open."""
        return None if self._part is None else self._part.open_path

    @property
    def unwritten_bytes(self) -> int:
        """Number of encoded bytes that are not written yet."""
        return 0 if self._part is None else self._part.unwritten_bytes

    def write(self, batch: Batch) -> None:
        """Write all messages of `batch`. Begin a new file afterwards if a limit is reached."""
        if batch.gap is not None:
            self._lose(batch.gap)

        part = self._part or self._open(batch)
        if part is None or (part.unwritten_bytes > MOST_UNWRITTEN_BYTES and not self._flush(part)):
            self._lose_messages(batch.first_sequence, batch.next_sequence)
            return

        # Record the gap of messages that were lost before `batch`, and the state after them.
        if self._gap is not None:
            gap, self._gap = self._gap, None
            part.add(GAP, gap.to_t_ns, gap.to_t_ns, batch.first_sequence, orjson.dumps(gap))
            self._add_snapshot(part, batch.before, batch.first_sequence)

        paused_until_s = time.monotonic() + _LONGEST_PAUSED_S
        for index, message in enumerate(batch.messages):
            self._add(part, batch.first_sequence + index, message)
            if (
                index % _YIELD_MESSAGES == _YIELD_MESSAGES - 1
                and self.pause_s
                and time.monotonic() < paused_until_s
            ):
                time.sleep(self.pause_s)

        self._added_sequence = batch.next_sequence
        if self._flush(part) and (
            part.size_bytes >= self.limits.file_bytes
            or time.monotonic() - self._opened_s >= self.limits.file_s
        ):
            self._finish(part, batch.next_sequence, "rotated")

    def close(self, next_sequence: int) -> None:
        """Finish the current file. A file that cannot be finished is repaired later."""
        if self._part is not None:
            self._finish(self._part, next_sequence, "stopped")

    # --- files -------------------------------------------------------------------------------

    def _open(self, batch: Batch) -> PartFile | None:
        """Create the next file and return it; return None if it cannot be created."""
        now_s = time.monotonic()
        if now_s < self._retry_s:
            return None

        self._retry_s = now_s + RETRY_S
        before, t_ns = batch.before, time.monotonic_ns()
        offset_ns = before.unix_offset_ns
        info = RecordingInfo(
            FORMAT,
            self.session,
            self._number + 1,
            self.rig,
            self.began_with_daemon,
            time.time_ns() - time.monotonic_ns() if offset_ns is None else offset_ns,
            batch.first_sequence,
            t_ns,
            SOFTWARE,
        )
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            sync_directory(self.directory.parent)
            documents = (before if before.configured else batch.after).attachments()
            part = self._create(info, documents)
        except OSError as error:
            self._report_fault(error)
            return None

        self._part, self._number, self._opened_s = part, self._number + 1, now_s
        self._saved_sequence = self._added_sequence = batch.first_sequence
        self._retry_s = 0.0
        self._now_ns = self._now_ns or t_ns
        self._add_snapshot(part, before, batch.first_sequence)
        self._delete_oldest()
        return part

    def _delete_oldest(self) -> None:
        try:
            deleted = delete_oldest(self.directory, self.rig, self.limits.keep_bytes)
        except OSError as error:
            text = f"old recordings cannot be deleted: {error.filename}: {error.strerror}"
            self.reports.append(RecordingReport(text, NoticeLevel.WARNING))
            return
        if deleted:
            names = ", ".join(path.name for path in deleted)
            text = f"oldest recordings deleted, because [recording] keep_gb is reached: {names}"
            self.reports.append(RecordingReport(text))

    def _create(self, info: RecordingInfo, attachments: Sequence[RecordedAttachment]) -> PartFile:
        """Create the file of `info`.

        The names of all files contain the start time of the session in whole seconds.
        """
        unix_s = (info.start_t_ns + info.unix_offset_ns) // 10**9
        while True:
            if not self._stem:
                started = datetime.fromtimestamp(unix_s, tz=UTC)
                self._stem = f"{self.rig}-{started:%Y%m%dT%H%M%S}"
            try:
                path = self.directory / f"{self._stem}-{info.part:04d}.mcap"
                part = PartFile(path, info, attachments)
            except FileExistsError:  # another session began in the same second
                if info.part > 1:
                    raise
                self._stem, unix_s = "", unix_s + 1
                continue
            try:
                part.flush()
                sync_directory(self.directory)  # not all file systems write the name with the file
            except OSError:  # delete a file without messages
                part.discard()
                raise
            return part

    def _flush(self, part: PartFile) -> bool:
        """Write all waiting bytes; return False if this failed."""
        try:
            part.flush()
        except OSError as error:
            self._report_fault(error)
            now_s = time.monotonic()
            self._failed_s = self._failed_s or now_s
            if error.errno == errno.EFBIG or (
                error.errno not in _FULL and now_s - self._failed_s > ABANDON_S
            ):
                part.close()
                self._part, self._failed_s = None, None
                self._finished_bytes += part.size_bytes - part.unwritten_bytes
                self._lose_messages(self._saved_sequence, self._added_sequence)
            return False

        self._failed_s, self._saved_sequence = None, self._added_sequence
        self.written_bytes = self._finished_bytes + part.size_bytes
        if self.fault is not None:
            self.fault, lost = None, self.lost - self._lost_before
            text = f"{part.path.name}: recording resumed, {lost} messages were lost"
            self.reports.append(RecordingReport(text, NoticeLevel.WARNING))
        return True

    def _finish(self, part: PartFile, next_sequence: int, reason: str) -> None:
        self._part = None
        try:
            part.finish(next_sequence, reason)
        except OSError as error:
            self._report_fault(error)
            self._lose_messages(self._saved_sequence, self._added_sequence)
        self._finished_bytes += part.size_bytes
        self.written_bytes = self._finished_bytes

    def _report_fault(self, error: OSError) -> None:
        text = f"{error.filename or self.directory}: {error.strerror}"
        if self.fault is None:
            self._lost_before = self.lost
            report = (
                f"recording is interrupted: {text}. The daemon continues, and the recording "
                "resumes when the disk takes data again"
            )
            self.reports.append(RecordingReport(report, NoticeLevel.ERROR))
        self.fault = text

    # --- messages ----------------------------------------------------------------------------

    def _add(self, part: PartFile, sequence: int, message: object) -> None:
        """Encode one message, and add it to the file."""
        if isinstance(message, ChunkArrived):
            t_ns, data = message.chunk.t_ns, message.chunk.data
            self._now_ns = t_ns
            part.add(SOURCE + message.source, t_ns, t_ns, sequence, data)
        elif (kind := type(message)) in EVENT_CHANNELS:
            event = cast("UnchunkedEvent", message)
            self._now_ns = event.t_ns
            part.add(EVENT_CHANNELS[kind], event.t_ns, event.t_ns, sequence, encode_event(event))
        elif kind in OUTPUT_KINDS:
            encoded = encode_output(cast("Output", message))
            if encoded is not None:
                t_ns = getattr(message, "t_ns", self._now_ns)
                log_ns = message.completed_ns if isinstance(message, LimbState) else self._now_ns
                part.add(encoded[0], log_ns, t_ns, sequence, encoded[1])
        elif isinstance(message, DaemonMessage):
            channel, t_ns, content = message
            part.add(channel, t_ns, t_ns, sequence, encode_json(content))

    def _add_snapshot(self, part: PartFile, snapshot: Snapshot, sequence: int) -> None:
        for event in snapshot.events(self._now_ns):
            if isinstance(event, ChunkArrived):
                channel, data = SNAPSHOT + SOURCE + event.source, event.chunk.data
            else:
                channel, data = SNAPSHOT + EVENT_KINDS[type(event)], encode_event(event)
            part.add(channel, self._now_ns, self._now_ns, sequence, data)

    # --- losses ------------------------------------------------------------------------------

    def _lose(self, gap: RecordingGap) -> None:
        """Store which consecutive messages were lost, until the gap can be recorded."""
        self.lost += gap.count
        before = self._gap
        if before is not None:
            count = gap.first_sequence + gap.count - before.first_sequence
            gap = RecordingGap(
                before.first_sequence, count, before.from_t_ns, gap.to_t_ns, before.reason
            )
        self._gap = gap

    def _lose_messages(self, first: int, following: int) -> None:
        """Count all messages from `first` up to, but not including, `following`, as lost."""
        if following > first:
            now_ns = time.monotonic_ns()
            reason = self.fault or "the disk is too slow"
            begin_ns = self._now_ns or now_ns
            self._lose(RecordingGap(first, following - first, begin_ns, now_ns, reason))
