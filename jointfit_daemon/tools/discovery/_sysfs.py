"""Reading of attributes in sysfs and procfs, which are small text files."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


def read_attribute(path: Path) -> str | None:
    """Return the text of an attribute without its line end; None if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:  # missing, or not readable in this state of the device
        return None


def read_number(path: Path, base: int = 10) -> int | None:
    """Return an attribute as integer; None if it cannot be read or is not a number."""
    try:
        return int(read_attribute(path) or "", base)
    except ValueError:
        return None
