"""Counter of the messages of one device that yielded no sample."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import Corrupt

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded


class Refusals:
    """Counts messages that yielded no sample."""

    def __init__(self) -> None:
        self.refused = self.refused_bytes = 0
        """Number of messages that yielded no sample, and the number of their bytes."""

    def refuse(self, size: int, reason: str) -> Corrupt:
        """Count a message of `size` bytes that yields no sample, and return it as `Corrupt`."""
        self.refused += 1
        self.refused_bytes += size
        return Corrupt(size, reason, rejected=1)

    def flush(self) -> list[Decoded]:
        """Reject the sample that waits for confirmation, and return the events.

        A subclass may delay a sample whose time or counter contradicts the samples before it, until
        the next sample confirms or contradicts it.
        """
        return []
