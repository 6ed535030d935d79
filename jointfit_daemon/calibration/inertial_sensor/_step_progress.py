"""Progress of one step of a sensor calibration."""

from __future__ import annotations

from typing import NamedTuple


class StepProgress(NamedTuple):
    """Readings that a step has collected, and readings that the step still needs."""

    share: float
    """Share of the required readings, 0 to 1."""
    missing: tuple[str, ...]
    """Poses or directions that are missing, in words."""
    note: str = ""
    """Reason why readings were discarded, or empty."""
