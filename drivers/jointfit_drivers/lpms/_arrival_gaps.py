"""Detection of losses in a stream without device time and counter, from the arrival times alone.

The delay of a sample is its arrival minus the arrival expected from the nominal rate. A lost sample
increases the delays of all later samples by a whole period. A busy bus or host increases the delays
of only some samples. The smallest delay of every ten samples distinguishes the two cases.

Invariant: the result depends only on the arrival stamps.
"""

from __future__ import annotations

from typing import NamedTuple

from jointfit_daemon.units import NS_PER_S

_SAMPLES = 10
"""Number of samples in a window. The smallest delay of each window is used."""
_LOST = 0.75
"""Increase of the smallest delay that proves a loss, in periods."""
_DRIFT = 0.1
"""Largest increase of the smallest delay per window that the skew of a clock causes, in periods."""
_WRONG_RATE = 0.2
"""Smallest relative difference between mean and nominal interval at which the rate counts as
wrong."""
_WINDOWS = 3
"""Number of consecutive windows that prove a different rate."""


class ArrivalStep(NamedTuple):
    """Result of adding one sample."""

    lost: int = 0
    """Number of samples lost before this sample."""
    rate_hz: float | None = None
    """Measured rate, Hz, if an unexpected rate is detected at this sample; None otherwise."""


_CONTINUES = ArrivalStep()


class ArrivalGaps:
    """Detects losses from the arrivals of one sensor.

    Parameters
    ----------
    rate_hz : float
        Nominal rate, Hz.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = NS_PER_S / rate_hz
        self._due_ns: float | None = None
        self._base_ns: float | None = None
        self._least_ns = float("inf")
        self._count = self._wrong = 0
        self._since_ns = 0

    def add(self, t_ns: int) -> ArrivalStep:
        """Add a sample that arrived at `t_ns`; return the loss or rate that it reveals."""
        if self._due_ns is None:
            self._due_ns, self._since_ns = float(t_ns), t_ns
            self._least_ns = 0.0
            return _CONTINUES

        self._due_ns += self._period_ns
        self._least_ns = min(self._least_ns, t_ns - self._due_ns)
        self._count += 1
        return _CONTINUES if self._count < _SAMPLES else self._end_window(t_ns)

    def _end_window(self, t_ns: int) -> ArrivalStep:
        mean_ns = (t_ns - self._since_ns) / self._count
        least_ns, base_ns = self._least_ns, self._base_ns
        self._since_ns, self._count, self._least_ns = t_ns, 0, float("inf")

        is_wrong = abs(mean_ns / self._period_ns - 1) > _WRONG_RATE
        self._wrong = self._wrong + 1 if is_wrong else 0
        if self._wrong >= _WINDOWS and mean_ns > 0:
            self._period_ns, self._due_ns = mean_ns, float(t_ns)
            self._base_ns, self._wrong = 0.0, 0
            return ArrivalStep(rate_hz=NS_PER_S / mean_ns)

        if base_ns is None:
            self._base_ns = least_ns
            return _CONTINUES
        delay = (least_ns - base_ns) / self._period_ns
        if delay > _LOST:
            self._base_ns = least_ns
            return ArrivalStep(round(delay))
        # The window in which the loss occurred also contains some delays from before the loss.
        self._base_ns = min(least_ns, base_ns + _DRIFT * self._period_ns)
        return _CONTINUES
