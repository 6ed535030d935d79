"""Unit of 16-bit quaternions, determined from their norm.

LPMS sensors send a component in units of 1/10000; older firmware sends 1/1000, and relatives of the
format 1/32767. A unit quaternion in integers has one of these norms, which are far apart.

Invariant: pure arithmetic on counts; the same counts give the same unit.
"""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

UNITS = (10_000, 1_000, 32_767)
"""Counts of 1.0 that are known, the most frequent first."""
COARSE = 1_000
"""Unit in thousandths, whose rounding changes the norm most."""
_TOLERANCE = {10_000: 0.01, 1_000: 0.05, 32_767: 0.01}
_CORRECTED = 10
"""Consecutive quaternions of another unit that correct the first finding."""


def unit_of(counts: Sequence[float]) -> int | None:
    """Return the unit in which `counts` have the norm 1; None if there is none."""
    norm = sqrt(sum(count * count for count in counts))
    return next((unit for unit in UNITS if abs(norm / unit - 1) <= _TOLERANCE[unit]), None)


class QuaternionScale:
    """Unit of one stream of 16-bit quaternions.

    Parameters
    ----------
    unit : int, optional
        Configured counts of 1.0; None: determined from the first quaternion that has a unit, and
        corrected by ten consecutive ones of another unit.
    """

    def __init__(self, unit: int | None = None) -> None:
        self.unit = unit
        """Counts of 1.0; None while undetermined."""
        self._is_configured = unit is not None
        self._others = 0

    def feed(self, counts: Sequence[float]) -> int | None:
        """Add a quaternion and return the unit."""
        if self._is_configured:
            return self.unit
        unit = unit_of(counts)
        if unit == self.unit or unit is None:
            self._others = 0
        else:
            self._others += 1
            if self.unit is None or self._others >= _CORRECTED:
                self.unit, self._others = unit, 0
        return self.unit
