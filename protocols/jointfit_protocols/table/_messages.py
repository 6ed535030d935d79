"""Output of the serial codecs of tables."""

from __future__ import annotations

from typing import NamedTuple

from jointfit_protocols.corrupt import CorruptBytes


class TableMessage(NamedTuple):
    """One sample as sent."""

    values: tuple[float, ...]
    """Record of the sample: counts of binary frames, numbers of text lines."""
    data: bytes
    """Bytes of the message on the wire."""
    end: int
    """Bytes fed to the codec up to and including its last one, for back-dating."""

    @property
    def size(self) -> int:
        """Bytes on the wire."""
        return len(self.data)


TableItem = TableMessage | CorruptBytes
