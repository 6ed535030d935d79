"""Result of writing a session to files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


class NothingToWriteError(ValueError):
    """The session contains no data that the format can store; the message states the remedy."""


@dataclass(frozen=True, slots=True)
class WrittenSession:
    """Files that were written for one session in one format."""

    files: tuple[Path, ...]
    notes: tuple[str, ...] = ()
    """Notes on series that were omitted, truncated or resampled."""
