"""Report of every codec about bytes that contain no message.

Invariant: a codec never raises on input. Corruption is a value with its number of bytes and reason.
"""

from __future__ import annotations

from typing import Any, NamedTuple, final

NO_START = "no message starts here"
CHECKSUM = "checksum"
CUT_OFF = "cut off"


@final
class CorruptBytes(NamedTuple):
    """A run of input without a message."""

    discarded: int
    """Discarded bytes."""
    reason: str
    """Reason, in a few words."""


class CorruptRun:
    """Joins bytes without a message to runs.

    Parameters
    ----------
    longest : int
        Bytes after which a run is reported, so that the sum of corrupt bytes is up to date.
    no_start : str
        Reason of bytes outside all candidates.
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
        """Add bytes; the first fault inside a candidate names the run."""
        self.discarded += count
        if self.count == 0 or self._reason == self._no_start:
            self._reason = reason
        self.count += count
        while self.count >= self._longest:
            found.append(CorruptBytes(self._longest, self._reason))
            self.count -= self._longest
            self._reason = reason

    def end(self, found: list[Any]) -> None:
        """Report the run, if there is one."""
        if self.count:
            found.append(CorruptBytes(self.count, self._reason))
            self.count = 0
