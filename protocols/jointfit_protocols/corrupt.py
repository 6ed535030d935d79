"""What every codec says about bytes that made no message.

Law: a codec never raises on input. Corruption is a value, counted in bytes, with its reason.
"""

from __future__ import annotations

from typing import NamedTuple


class Corrupt(NamedTuple):
    """A run of input that made no message."""

    discarded: int
    """Bytes given up."""
    reason: str
    """Why, in a few words."""
