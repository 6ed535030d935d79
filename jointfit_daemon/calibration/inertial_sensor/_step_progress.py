"""Progress of one step of a sensor calibration."""

from __future__ import annotations

from typing import NamedTuple


class StepProgress(NamedTuple):
    """Progress of a step, with the poses or directions that are still missing."""

    share: float
    """Fraction of the required readings that are collected, 0 to 1."""
    missing: tuple[str, ...]
    """Names of the missing poses or directions."""
    note: str = ""
    """Reason why readings were discarded; empty if none were discarded."""
