"""One file of a recording that is being written.

Invariant: after a failed write, the next write continues with the first byte that was not
written, so the file has no damaged range.
"""

from __future__ import annotations

import errno
import fcntl
import os
from contextlib import suppress
from typing import IO, TYPE_CHECKING, Any, NamedTuple, cast

from mcap.writer import Writer

from jointfit_daemon.outputs.recording._channels import (
    CHANNEL_METADATA,
    END_METADATA,
    PROFILE,
    RECORDING_METADATA,
    channel_form,
    schema_of,
)
from jointfit_daemon.outputs.recording._description import seal

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from jointfit_daemon.outputs.recording._description import RecordingInfo

UNFINISHED = ".part"
"""Suffix of the file name while the file is being written."""
_SEQUENCES = 2**32
"""Modulus of the sequence numbers in MCAP files."""
_CHUNK_BYTES = 1024 * 1024
"""Size above which a chunk is closed without waiting for the next flush, and largest size of a
write, bytes."""


class RecordedAttachment(NamedTuple):
    """A document that is stored in every file of a recording."""

    name: str
    media_type: str
    data: bytes


class PartFile:
    """One file, created as ``NAME.mcap.part`` and renamed to ``NAME.mcap`` when it is complete.

    Parameters
    ----------
    path
        Final path of the file.
    info
        Description of the file.
    attachments
        Documents to store at the beginning of the file.
    suffix
        Suffix of the file name while the file is being written.

    Raises
    ------
    OSError
        The file cannot be created. FileExistsError means that the file exists, possibly with its
        final name.
    """

    def __init__(
        self,
        path: Path,
        info: RecordingInfo,
        attachments: Sequence[RecordedAttachment],
        *,
        suffix: str = UNFINISHED,
    ) -> None:
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
        self.path, self.info = path, info
        self.open_path = path.with_name(path.name + suffix)
        self._fd = os.open(
            self.open_path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600
        )
        with suppress(OSError):  # some network file systems have no locks
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)

        self._buffer = _UnwrittenBytes()
        # Message indexes take 16 bytes per message, but Foxglove and PlotJuggler need them.
        self._writer: Any = Writer(cast("IO[bytes]", self._buffer), _CHUNK_BYTES)
        self._writer.start(PROFILE, info.software)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {"": 0}

        # The description is written twice, because a file without a description cannot be read.
        unix_ns = info.start_t_ns + info.unix_offset_ns
        self._writer.add_metadata(RECORDING_METADATA, info.metadata())
        for name, media_type, data in attachments:
            self._writer.add_attachment(unix_ns, unix_ns, name, media_type, data)
        self._writer.add_metadata(RECORDING_METADATA, info.metadata())

    @property
    def size_bytes(self) -> int:
        """Size of the file, including bytes that are not written yet."""
        return self._buffer.tell()

    @property
    def unwritten_bytes(self) -> int:
        """Number of bytes that are not written to the disk yet."""
        return self._buffer.unwritten_bytes

    def add(self, channel: str, log_ns: int, publish_ns: int, sequence: int, data: bytes) -> None:
        """Add one message.

        `log_ns` is its arrival, and `publish_ns` the instant to which its content refers, both
        CLOCK_MONOTONIC ns. `sequence` is the number of the message in the session.
        """
        number = self._channels.get(channel) or self._register(channel)
        offset_ns = self.info.unix_offset_ns
        self._writer.add_message(
            number, log_ns + offset_ns, data, publish_ns + offset_ns, sequence % _SEQUENCES
        )

    def _register(self, channel: str) -> int:
        form = channel_form(channel)
        if form.schema not in self._schemas:
            schema = schema_of(form.schema)
            self._schemas[form.schema] = self._writer.register_schema(
                form.schema, "jsonschema", schema
            )

        # The definition is also written outside of the chunk, because the chunk may be damaged
        # later.
        number: int = self._writer.register_channel(
            channel, form.encoding, self._schemas[form.schema], form.metadata
        )
        self._channels[channel] = number
        self._writer.add_metadata(CHANNEL_METADATA, seal({"id": str(number), "topic": channel}))
        return number

    def flush(self) -> None:
        """Write all messages, and wait until they are on the disk.

        Raises
        ------
        OSError
            Some bytes were not written; the next call writes them.
        """
        self._writer.flush()
        self._buffer.write_to(self._fd)
        os.fdatasync(self._fd)

    def finish(self, next_sequence: int, reason: str) -> None:
        """Write the end and the index of the file, and rename it to its final name.

        Parameters
        ----------
        next_sequence
            Sequence number of the first message after this file.
        reason
            Reason why the file ends: ``rotated``, ``stopped`` or ``recovered``.

        Raises
        ------
        OSError
            The end was not written, so the file keeps the suffix of an unfinished file. If only
            the folder could not be written to the disk, the file has its final name.
        """
        try:
            self._writer.flush()
            end = seal({"next_sequence": str(next_sequence), "reason": reason})
            self._writer.add_metadata(END_METADATA, end)
            self._writer.finish()
            self._buffer.write_to(self._fd)
            os.fsync(self._fd)
            self.open_path.rename(self.path)
            sync_directory(self.path.parent)
        finally:
            self.close()

    def discard(self) -> None:
        """Close and delete the file."""
        self.close()
        self.open_path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file without writing its end."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            with suppress(OSError):
                os.close(fd)


def sync_directory(directory: Path) -> None:
    """Write the directory entries of new files to the disk."""
    fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


class _UnwrittenBytes:
    """Buffer for the bytes from the MCAP library, which would lose bytes if a write failed."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._written = 0

    @property
    def unwritten_bytes(self) -> int:
        return len(self._data)

    def write(self, data: bytes) -> int:
        self._data += data
        return len(data)

    def tell(self) -> int:
        return self._written + len(self._data)

    def flush(self) -> None:
        """Do nothing, because `write_to` writes the bytes."""

    def write_to(self, fd: int) -> None:
        """Write all bytes to `fd`. After an OSError, the unwritten bytes stay in the buffer."""
        done = 0
        try:
            while done < len(self._data):
                done += os.write(fd, self._data[done : done + _CHUNK_BYTES])
        finally:
            del self._data[:done]
            self._written += done
