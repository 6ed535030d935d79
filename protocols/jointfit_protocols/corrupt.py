"""Report of a codec about bytes that contain no message.

Invariant: a codec never raises an exception because of its input. It reports corruption as a value
with a number of bytes and a reason.
"""

from __future__ import annotations

from typing import Any, NamedTuple, final

NO_START = "no message starts here"
CHECKSUM = "checksum"
CUT_OFF = "cut off"


@final
class CorruptBytes(NamedTuple):
    """A run of consecutive input bytes that contain no message."""

    discarded: int
    """Number of discarded bytes."""
    reason: str
    """Short reason why the bytes were discarded."""


class CorruptRun:
    """Combines consecutive bytes without a message into runs.

    Parameters
    ----------
    longest : int
        Number of bytes after which a run is reported, so that the count of corrupt bytes is up to
        date.
    no_start : str
        Reason that is reported for bytes outside of all possible messages.
    """

    def __init__(self, longest: int, no_start: str = NO_START) -> None:
        self._longest = longest
        self._no_start = no_start
        self._reason = ""
        self.count = 0
        """Length of the current run so far, bytes."""
        self.discarded = 0
        """Total length of all runs so far, bytes."""

    def add(self, count: int, reason: str, found: list[Any]) -> None:
        """Add bytes to the run.

        The first fault inside a possible message becomes the reason of the run.
        """
        self.discarded += count
        if self.count == 0 or self._reason == self._no_start:
            self._reason = reason
        self.count += count
        while self.count >= self._longest:
            found.append(CorruptBytes(self._longest, self._reason))
            self.count -= self._longest
            self._reason = reason

    def end(self, found: list[Any]) -> None:
        """Report the current run if there is one."""
        if self.count:
            found.append(CorruptBytes(self.count, self._reason))
            self.count = 0
