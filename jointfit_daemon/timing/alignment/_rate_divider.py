"""Selection of frames at a lower rate."""

from __future__ import annotations

_FAR = 10
"""Largest time, periods, by which a frame may precede the next grid time. An earlier frame restarts
the grid.
"""


class RateDivider:
    """Selects frames at a lower rate from frames with increasing timestamps.

    For every time of a regular grid, the first frame at or after this time is selected. The mean
    rate is therefore `rate_hz`, even if no frame lies exactly on a grid time. The grid restarts
    after a pause. It also restarts after a timestamp far in the future, which would otherwise
    exclude all frames with earlier timestamps.

    Parameters
    ----------
    rate_hz : float
        Rate of the selected frames, Hz; above 0.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = round(1e9 / rate_hz)
        self._next_ns = 0

    def is_due(self, t_ns: int) -> bool:
        """Return whether the frame with this timestamp is selected; if so, advance the grid."""
        early_ns = self._next_ns - t_ns
        if 0 < early_ns <= _FAR * self._period_ns:
            return False
        restarts = abs(early_ns) > self._period_ns
        self._next_ns = (t_ns if restarts else self._next_ns) + self._period_ns
        return True
