"""Unit of 16-bit quaternions, which is determined from their norm.

LPMS sensors send a component in units of 1/10000. Older firmware uses 1/1000, and devices with a
related format use 1/32767. The norm of a unit quaternion in integers is near one of these numbers,
which are far apart.

Invariant: the result depends only on the counts fed.
"""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

UNITS = (10_000, 1_000, 32_767)
"""Known numbers of counts for 1.0, the most frequent first."""
COARSE = 1_000
"""Number of counts for 1.0 at which rounding changes the norm most."""
_TOLERANCE = {10_000: 0.01, 1_000: 0.05, 32_767: 0.01}
_CORRECTED = 10
"""Number of consecutive quaternions in another unit that correct the first result."""


def unit_of(counts: Sequence[float]) -> int | None:
    """Return the unit in which `counts` have the norm 1; None if no known unit fits."""
    norm = sqrt(sum(count * count for count in counts))
    return next((unit for unit in UNITS if abs(norm / unit - 1) <= _TOLERANCE[unit]), None)


class QuaternionScale:
    """Determines the unit of one stream of 16-bit quaternions.

    Parameters
    ----------
    unit : int, optional
        Configured number of counts for 1.0. None: the first quaternion with a known unit determines
        it, and ten consecutive quaternions in another unit correct it.
    """

    def __init__(self, unit: int | None = None) -> None:
        self.unit = unit
        """Number of counts for 1.0; None while it is unknown."""
        self._is_configured = unit is not None
        self._others = 0

    def feed(self, counts: Sequence[float]) -> int | None:
        """Add a quaternion, and return the unit; None while it is unknown."""
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
