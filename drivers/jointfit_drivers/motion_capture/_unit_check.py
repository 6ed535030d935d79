"""Detection of a wrong unit of length from the size of the coordinates.

Camera volumes are smaller than 50 m, and a tracked body rarely stays within 20 mm of the origin.

Invariant: the module is pure, and returns at most one warning.
"""

from __future__ import annotations

_LARGEST_M = 50.0
"""Coordinate that exceeds every camera volume, m."""
_SMALLEST_MM = 20.0
"""Coordinate that at least one of the first `_REPORTS` positions in mm exceeds, mm."""
_REPORTS = 500
"""Number of positions that are checked."""


class UnitCheck:
    """Checks the first positions of a server.

    Parameters
    ----------
    unit : str
        Configured unit. Only ``m`` and ``mm`` are checked.
    """

    def __init__(self, unit: str) -> None:
        self._unit = unit
        self._largest = 0.0
        self._reports = 0

    def feed(self, x: float, y: float, z: float) -> str | None:
        """Add a position as sent by the server; return a new warning, or None."""
        if self._reports > _REPORTS:
            return None
        largest = max(abs(x), abs(y), abs(z))
        if not largest < float("inf"):
            return None

        self._reports += 1
        self._largest = max(self._largest, largest)
        if self._unit == "m" and self._largest > _LARGEST_M:
            self._reports = _REPORTS + 1
            return (
                f'coordinates up to {self._largest:.0f} with unit = "m": the server seems to send '
                'millimetres; set unit = "mm" in [mocap]'
            )

        if self._unit == "mm" and self._reports == _REPORTS:
            self._reports = _REPORTS + 1
            if self._largest < _SMALLEST_MM:
                return (
                    f'coordinates up to {self._largest:.2f} with unit = "mm": the server seems to '
                    'send metres; set unit = "m" in [mocap]'
                )
        return None
