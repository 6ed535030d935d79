"""Unit of the SampleTime of an XCDI device, determined from the data.

MT1604P gives microseconds, the vendor's current pages ticks of 100 us. The rate is thus near
10^6 or 10^4 ticks per second. These are two decades apart, more than jitter or a wrong nominal
rate explain.

Invariant: pure arithmetic on ticks and arrival stamps.
"""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from math import log10
from statistics import median

from jointfit_protocols.xcdi._messages import TICKS_MODULUS

TICK_NS = {"100us": 100_000, "1us": 1_000}
"""Duration of a tick, ns, by the name of the unit."""

_STEPS = 10
"""Steps before the unit is determined."""
_WINDOW = 200
"""Stored groups: half a second at 400 Hz."""
_NEAR = 0.5
"""Largest deviation from 10^4 or 10^6 ticks per second, decades."""
_NS = 1_000_000_000


class TickUnit:
    """Determines the unit from groups, once at least ten steps agree.

    The rate is the median step of SampleTime divided by the median step of arrival. If this is near
    neither rate (an adapter that delivers in blocks), the whole span is used instead.
    """

    def __init__(self) -> None:
        self._groups: deque[tuple[int, int]] = deque(maxlen=_WINDOW)
        self.ticks_per_s: float | None = None
        """Last measured rate, ticks/s; None before ten steps."""

    def restart(self) -> None:
        """Discard the groups: the device restarted."""
        self._groups.clear()

    def feed(self, ticks: int, t_ns: int) -> int | None:
        """Return the duration of a tick, ns (1 000 or 100 000), or None while undetermined."""
        self._groups.append((ticks, t_ns))
        if len(self._groups) <= _STEPS:
            return None

        pairs = list(pairwise(self._groups))
        tick_steps = [(b[0] - a[0]) % TICKS_MODULUS for a, b in pairs]
        time_steps = [b[1] - a[1] for a, b in pairs]

        for ticks_step, time_step in (
            (median(tick_steps), median(time_steps)),
            (sum(tick_steps), sum(time_steps)),
        ):
            if ticks_step > 0 and time_step > 0:
                self.ticks_per_s = ticks_step * _NS / time_step
                for tick_ns in TICK_NS.values():
                    if abs(log10(self.ticks_per_s * tick_ns / _NS)) < _NEAR:
                        return tick_ns
        return None
