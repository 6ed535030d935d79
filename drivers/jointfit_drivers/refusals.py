"""Count of the messages of one device that became no sample."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import Corrupt

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded


class Refusals:
    """Counts messages that became no sample."""

    def __init__(self) -> None:
        self.refused = self.refused_bytes = 0
        """Messages that became no sample, and their bytes."""

    def refuse(self, size: int, reason: str) -> Corrupt:
        """Count a message of `size` bytes that becomes no sample."""
        self.refused += 1
        self.refused_bytes += size
        return Corrupt(size, reason, rejected=1)

    def flush(self) -> list[Decoded]:
        """Refuse a sample that waits for confirmation; without such checks there is none."""
        return []
