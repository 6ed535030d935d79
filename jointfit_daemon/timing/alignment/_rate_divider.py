"""Selection of frames at a lower rate."""

from __future__ import annotations

_FAR = 10
"""Periods by which a frame is too early for the grid; less is a frame out of order."""


class RateDivider:
    """Selects from frames with increasing stamps those that keep to a lower rate.

    The selected frames lie on a grid, so that their mean rate is `rate_hz` although no frame lies
    exactly on a grid time. The grid begins again after a pause, and after a stamp far ahead of the
    others, which would otherwise exclude all frames up to its time.

    Parameters
    ----------
    rate_hz : float
        Rate of the selected frames, Hz; above 0.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = round(1e9 / rate_hz)
        self._next_ns = 0

    def is_due(self, t_ns: int) -> bool:
        """Return whether the frame with this stamp is selected, and count it if it is."""
        early_ns = self._next_ns - t_ns
        if 0 < early_ns <= _FAR * self._period_ns:
            return False
        restarts = abs(early_ns) > self._period_ns
        self._next_ns = (t_ns if restarts else self._next_ns) + self._period_ns
        return True
