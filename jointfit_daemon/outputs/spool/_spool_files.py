"""Files of the spool: messages in the order in which they were written, in files of limited size.

A line consists of a CRC-32 in hexadecimal digits, the topic relative to the base, and the payload,
separated by spaces. The CRC covers the rest of the line. A process appends only to files that it
created. A power cut can therefore damage only the last line of a file.

Invariant: after each write, the total size exceeds `keep_bytes` only if there is a single file.
Otherwise the oldest files are deleted, and their messages are counted. A line with a wrong CRC is
counted and skipped.
"""

from __future__ import annotations

import contextlib
import os
import re
from typing import TYPE_CHECKING, NamedTuple
from zlib import crc32

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

FILES = 16
"""Number of files in a full spool. Files are deleted one at a time."""
_TOPIC = re.compile(r"[!-~]{1,200}")
"""Pattern of a topic: printable ASCII. Subscribers reject topics with wildcards, spaces or control
characters."""
_WILDCARDS = frozenset("+#")
_NUMBERED = re.compile(r"(\d{8})\.spool")


class SpooledMessage(NamedTuple):
    """One message that waits for the broker."""

    topic: str
    """Topic relative to the base topic."""
    payload: bytes


class SpoolFiles:
    """The spool of one rig; its methods block.

    Parameters
    ----------
    folder
        Folder for the files, which is created with the first message.
    keep_bytes
        Largest total size of the files, bytes.
    """

    def __init__(self, folder: Path, keep_bytes: int) -> None:
        self._folder, self._keep_bytes = folder, keep_bytes
        self._counts: dict[int, int] = {}
        """Number of messages in each file, by file number, oldest first."""
        self._sizes: dict[int, int] = {}
        self._open: int | None = None
        """File to which this process appends."""
        self._last = 0
        self.dropped = 0
        """Number of messages that were deleted because the spool was full."""
        self.damaged = 0
        """Number of unreadable lines."""

    @property
    def waiting(self) -> int:
        """Number of stored messages."""
        return sum(self._counts.values())

    @property
    def size_bytes(self) -> int:
        """Total size of the files, bytes."""
        return sum(self._sizes.values())

    def load(self) -> None:
        """Find the files of earlier processes, and delete files without a readable message.

        Raises
        ------
        OSError
            A file cannot be read or deleted.
        """
        if not self._folder.is_dir():
            return
        found = (_NUMBERED.fullmatch(path.name) for path in self._folder.iterdir())
        for number in sorted(int(match[1]) for match in found if match):
            messages, damaged = self._read(number)
            self._last = number
            self.damaged += damaged
            if messages:
                self._counts[number] = len(messages)
                self._sizes[number] = self._path(number).stat().st_size
            else:
                self._path(number).unlink()

    def append(self, messages: Iterable[SpooledMessage]) -> None:
        """Write messages to durable storage.

        Raises
        ------
        OSError
            The disk does not accept the messages. In this case, no message is written.
        """
        lines = [_line(message) for message in messages]
        if not lines:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        number = self._open or self._last + 1
        before = self._sizes.get(number, 0)
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        descriptor = os.open(self._path(number), flags, 0o600)
        try:
            data = b"".join(lines)
            while data:
                data = data[os.write(descriptor, data) :]
            os.fdatasync(descriptor)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(descriptor, before)
            raise
        finally:
            os.close(descriptor)

        self._last = self._open = number
        self._counts[number] = self._counts.get(number, 0) + len(lines)
        self._sizes[number] = before + sum(map(len, lines))
        if self._sizes[number] >= self._keep_bytes // FILES:
            self._open = None

        # The messages are stored already, so a failed deletion is no error: the next call repeats
        # it.
        with contextlib.suppress(OSError):
            while self.size_bytes > self._keep_bytes and len(self._counts) > 1:
                oldest = next(iter(self._counts))
                count = self._counts[oldest]
                self.remove(oldest)
                self.dropped += count

    def oldest(self) -> tuple[int, list[SpooledMessage]] | None:
        """Return number and messages of the oldest file; this file gets no further messages.

        Raises
        ------
        OSError
            The file cannot be read.
        """
        if not self._counts:
            return None
        number = next(iter(self._counts))
        if number == self._open:
            self._open = None
        return number, self._read(number)[0]

    def remove(self, number: int) -> None:
        """Delete a file.

        Raises
        ------
        OSError
            The file cannot be deleted.
        """
        self._path(number).unlink(missing_ok=True)
        self._counts.pop(number, None)
        self._sizes.pop(number, None)

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:08d}.spool"

    def _read(self, number: int) -> tuple[list[SpooledMessage], int]:
        """Return the messages of a file, and the number of damaged lines."""
        with self._path(number).open("rb") as file:
            lines = file.read(2 * self._keep_bytes).splitlines(keepends=True)
        found = [_message(line) for line in lines]
        messages = [message for message in found if message is not None]
        return messages, len(found) - len(messages)


def _line(message: SpooledMessage) -> bytes:
    rest = b"%s %s" % (message.topic.encode(), message.payload)
    return b"%08x %s\n" % (crc32(rest), rest)


def _message(line: bytes) -> SpooledMessage | None:
    """Return the message of a line; None for a damaged line."""
    digits, _, rest = line.removesuffix(b"\n").partition(b" ")
    topic, _, payload = rest.partition(b" ")
    if not line.endswith(b"\n") or digits != b"%08x" % crc32(rest):
        return None
    name = topic.decode("ascii", "replace")
    if not _TOPIC.fullmatch(name) or _WILDCARDS & set(name):
        return None
    return SpooledMessage(name, payload)
