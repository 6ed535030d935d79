"""Which unit the SampleTime of an XCDI device counts in, decided from what arrives.

Law: pure arithmetic on ticks and arrival stamps. MT1604P says microseconds, the vendor's current
pages say ticks of 100 us; the truth is near 10^6 or 10^4 ticks a second, two decades apart, so
neither jitter nor a wrong nominal rate can blur it.
"""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from math import log10
from statistics import median

from jointfit_protocols.xcdi._messages import TICKS_MODULUS

TICK_NS = {"100us": 100_000, "1us": 1_000}
"""Nanoseconds a tick, for each name of a unit."""

_STEPS = 10  # at least, before anything is decided
_WINDOW = 200  # remembered: half a second at 400 Hz
_NEAR = 0.5  # decades from 10^4 or 10^6 ticks a second
_NS = 1_000_000_000


class TickUnit:
    """Groups in, unit out, once at least ten steps agree.

    The rate is the median step of SampleTime divided by the median step of arrival; where arrival
    is bunched (an adapter that delivers in blocks) and that is near neither rate, by the whole
    span instead.
    """

    def __init__(self) -> None:
        self._seen: deque[tuple[int, int]] = deque(maxlen=_WINDOW)
        self.ticks_per_s: float | None = None
        """Last measured rate; None before ten steps."""

    def restart(self) -> None:
        """Forget: the device began anew."""
        self._seen.clear()

    def feed(self, ticks: int, t_ns: int) -> int | None:
        """Return the nanoseconds of a tick (1 000 or 100 000), or None while it is open."""
        self._seen.append((ticks, t_ns))
        if len(self._seen) <= _STEPS:
            return None
        pairs = list(pairwise(self._seen))
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
