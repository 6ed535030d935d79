"""Repair of a damaged or unfinished recording: its readable messages are copied to a clean file.

Invariant: the content of the source is not changed, and an incomplete copy is deleted.
"""

from __future__ import annotations

import fcntl
import os
import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import orjson

from jointfit_daemon.outputs.recording._blocks import RecordingError
from jointfit_daemon.outputs.recording._channels import GAP, recorded_rig_name
from jointfit_daemon.outputs.recording._description import RecordingGap
from jointfit_daemon.outputs.recording._part_file import UNFINISHED, PartFile, RecordedAttachment
from jointfit_daemon.outputs.recording._reader import Recording, open_part

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

_COPYING = ".repair"
"""Suffix of the copy while it is being written."""
DAMAGED = ".bad"
"""Suffix given to an unfinished file that is damaged before its end, or that was repaired before.
"""
_FLUSH_MESSAGES = 4096
"""Number of messages between two writes."""
_PAUSE_MESSAGES, _PAUSE_S = 32, 0.001
"""Number of messages that a running daemon copies without a pause, and the pause after them, s."""


class RepairStoppedError(Exception):
    """The repair was stopped before it was complete."""


@dataclass(frozen=True, slots=True)
class RepairResult:
    """Result of the repair of a recording."""

    source: Path
    path: Path
    """Path of the clean file."""
    messages: int
    seconds: float
    """Time from the first to the last message, s."""
    gaps: tuple[RecordingGap, ...]
    """Gaps of missing messages before the end."""
    unreadable_bytes: int
    """Number of bytes of the source that belong to no record, because they are damaged or
    incomplete."""
    closed: bool
    """Whether the source was closed. If not, messages of its last second may be missing."""


def repair_recording(
    source: Path,
    target: Path,
    *,
    pause: bool = False,
    stopped: Callable[[], bool] = lambda: False,
) -> RepairResult:
    """Copy all readable messages of one file.

    Parameters
    ----------
    source
        File to repair. It may be unfinished or damaged.
    target
        Path of the clean file, which must not exist.
    pause
        Whether to pause after every 32 messages, because the process also acquires data.
    stopped
        Function that returns True to stop the repair.

    Raises
    ------
    RecordingError
        The source is not a recording, contains no message, or another process is writing it.
    FileExistsError
        The target exists.
    OSError
        The source cannot be read, or the target cannot be written.
    RepairStoppedError
        `stopped` returned True.
    """
    with _lock_file(source):
        part = open_part(source)
        attachments = [
            RecordedAttachment(name, "application/json", data)
            for name, data in part.documents.items()
        ]
        clean = PartFile(target, part.info, attachments, suffix=_COPYING)
        try:
            result = _copy(Recording((part,)), clean, pause=pause, stopped=stopped)
        except BaseException:
            clean.discard()
            raise
    return result


def _copy(
    recording: Recording, clean: PartFile, *, pause: bool, stopped: Callable[[], bool]
) -> RepairResult:
    gaps: list[RecordingGap] = []
    count, first_ns = 0, None
    sequence, t_ns = recording.info.first_sequence, recording.info.start_t_ns
    for message in recording.messages():
        if isinstance(message, RecordingGap):
            gaps.append(message)
            sequence, t_ns = message.first_sequence + message.count, message.to_t_ns
            clean.add(GAP, t_ns, t_ns, sequence, orjson.dumps(message))
            continue

        clean.add(*message[1:4], message.sequence, message.data)
        count, t_ns = count + 1, message.t_ns
        first_ns = t_ns if first_ns is None else first_ns
        sequence = max(sequence, message.sequence + 1)
        if count % _FLUSH_MESSAGES == 0:
            clean.flush()
        if pause and count % _PAUSE_MESSAGES == 0:
            time.sleep(_PAUSE_S)
        if stopped():
            raise RepairStoppedError
    if first_ns is None:
        raise RecordingError(f"{recording.parts[0].path}: the recording contains no message")

    source = recording.parts[0]
    survey = source.survey()
    clean.finish(sequence, survey.end.reason or "recovered")
    return RepairResult(
        source.path,
        clean.path,
        count,
        (t_ns - first_ns) * 1e-9,
        tuple(gaps),
        sum(block.end - block.start for block in survey.damage),
        survey.end.next_sequence is not None,
    )


@contextmanager
def _lock_file(source: Path) -> Iterator[None]:
    """Lock the file during the ``with`` block; raise RecordingError if a daemon is writing it."""
    fd = os.open(source, os.O_RDONLY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RecordingError(
                f"{source}: a daemon is writing this recording: stop the recording first"
            ) from error
        except OSError:  # the file system has no locks
            pass
        yield
    finally:
        os.close(fd)


def repair_unfinished(
    directory: Path, rig: str, stopped: Callable[[], bool]
) -> list[RepairResult | str]:
    """Repair the files that earlier runs of `rig` left unfinished.

    A repaired file gets its final name, and the unfinished file is deleted. The unfinished file is
    renamed to ``….bad`` instead if it was damaged before its end, or if a file with the final name
    exists.

    Returns
    -------
    list of RepairResult or str
        Result of every repaired file, or the reason why a file was not repaired.
    """
    found: list[RepairResult | str] = []
    try:
        sources = sorted(directory.glob(f"*.mcap{UNFINISHED}"))
    except OSError:
        return found
    for source in sources:
        if recorded_rig_name(source.name) != rig:
            continue
        target = source.with_name(source.name.removesuffix(UNFINISHED))
        damaged = source.with_name(source.name + DAMAGED)
        try:
            if target.exists():  # a person has already repaired it
                source.rename(damaged)
                found.append(f"{source.name}: {target.name} exists already; renamed {damaged.name}")
                continue
            result = repair_recording(source, target, pause=True, stopped=stopped)
            if result.gaps:
                source.rename(damaged)
            else:
                source.unlink()
            found.append(result)
        except RepairStoppedError:
            break
        except (RecordingError, OSError) as error:
            if not _is_written(source):
                found.append(f"cannot be repaired: {error}")
    return found


def _is_written(source: Path) -> bool:
    try:
        with _lock_file(source):
            return False
    except (RecordingError, OSError):
        return True
