"""Output of the serial codecs of tables, and the account of bytes without a message.

Invariant: every byte fed belongs to one message, one skipped message, or one run of corrupt bytes.
"""

from __future__ import annotations

from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes


class TableMessage(NamedTuple):
    """One sample as sent."""

    values: tuple[float, ...]
    """Its record: counts of binary frames, numbers of text lines."""
    data: bytes
    """Its bytes on the wire."""
    end: int
    """Bytes fed to the codec up to and including its last one, for back-dating."""


TableItem = TableMessage | CorruptBytes


class CorruptRun:
    """Joins bytes without a message to runs.

    Parameters
    ----------
    longest : int
        Bytes after which a run is reported, so that the sum of corrupt bytes is up to date.
    """

    def __init__(self, longest: int) -> None:
        self._longest = longest
        self._count = 0
        self._reason = ""
        self.discarded = 0
        """Bytes so far."""

    def add(self, count: int, reason: str, found: list[TableItem]) -> None:
        """Add bytes; the first fault inside a candidate names the run."""
        self.discarded += count
        if self._count == 0 or self._reason == NO_START:
            self._reason = reason
        self._count += count
        while self._count >= self._longest:
            found.append(CorruptBytes(self._longest, self._reason))
            self._count -= self._longest
            self._reason = reason

    def end(self, found: list[TableItem]) -> None:
        """Report the run, if there is one."""
        if self._count:
            found.append(CorruptBytes(self._count, self._reason))
            self._count = 0


NO_START = "no message starts here"
CHECKSUM = "checksum"
CUT_OFF = "cut off"
