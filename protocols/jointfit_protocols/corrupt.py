"""Report of every codec about bytes that contain no message.

Invariant: a codec never raises on input. Corruption is a value with its number of bytes and reason.
"""

from __future__ import annotations

from typing import NamedTuple


class CorruptBytes(NamedTuple):
    """A run of input without a message."""

    discarded: int
    """Discarded bytes."""
    reason: str
    """Reason, in a few words."""
