"""Outcome of writing a session."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


class NothingToWriteError(ValueError):
    """The session has nothing that the format can hold; the message names a remedy."""


@dataclass(frozen=True, slots=True)
class WrittenSession:
    """Files of one session in one format."""

    files: tuple[Path, ...]
    notes: tuple[str, ...] = ()
    """Series that were left out, cut off or resampled."""
