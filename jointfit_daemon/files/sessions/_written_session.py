"""Result of writing a session to files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


class NothingToWriteError(ValueError):
    """The session has no data that the format can contain; the message gives a remedy."""


@dataclass(frozen=True, slots=True)
class WrittenSession:
    """Written files of one session in one format."""

    files: tuple[Path, ...]
    notes: tuple[str, ...] = ()
    """Notes on series that were left out, truncated or resampled."""
