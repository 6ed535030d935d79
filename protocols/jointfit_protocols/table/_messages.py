"""Message that the codecs of frames and lines return."""

from __future__ import annotations

from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes


class TableMessage(NamedTuple):
    """One sample, with its numbers as sent."""

    values: tuple[float, ...]
    """Record of the sample: counts in binary frames, numbers in text lines."""
    data: bytes
    """Bytes of the message on the wire."""
    end: int
    """Number of bytes fed to the codec until the end of the message. Drivers compute the
    arrival time of the first byte from this number."""

    @property
    def size(self) -> int:
        """Length of the message on the wire, bytes."""
        return len(self.data)


TableItem = TableMessage | CorruptBytes
