"""Output of the serial codecs of tables."""

from __future__ import annotations

from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes


class TableMessage(NamedTuple):
    """One sample as sent."""

    values: tuple[float, ...]
    """Record of the sample: counts of binary frames, numbers of text lines."""
    data: bytes
    """Length of the message on the wire, bytes."""
    end: int
    """Number of bytes fed to the codec up to and including the last byte of the message, for
    back-dating of the message."""

    @property
    def size(self) -> int:
        """Length on the wire, bytes."""
        return len(self.data)


TableItem = TableMessage | CorruptBytes
