"""Unit of the SampleTime of an XCDI device, determined from the data.

The vendor's document MT1604P (2019) states microseconds for SampleTime, and the vendor's current
web pages state ticks of 100 us. The rate is therefore near 10^6 or 10^4 ticks per second. These
rates differ by a factor of 100, which a wrong nominal rate cannot explain.

The first estimate uses no arrival times. It is the number of ticks per sample, from SampleTime and
GroupCounter, times the configured sample rate. Arrival times are not used because frames that were
buffered while the host was busy arrive within microseconds. A rate measured over few arrivals can
therefore be wrong by any factor. Arrivals over spans of at least a second are used in two cases:
the first estimate is near neither unit, or two consecutive spans contradict it.

Invariant: the result depends only on ticks, counters and arrival stamps.
"""

from __future__ import annotations

from math import log10
from statistics import median

from jointfit_protocols.xcdi._messages import COUNTER_MODULUS, TICKS_MODULUS

TICK_NS = {"100us": 100_000, "1us": 1_000}
"""Duration of a tick for each name of a unit, ns."""

_STEPS = 10
"""Number of steps after which the unit is determined."""
_NEAR = 0.5
"""Largest deviation from 10^4 or 10^6 ticks per second, as a difference of decimal logarithms."""
_SPAN_NS = 1_000_000_000
"""Shortest span of arrivals over which the rate is measured, ns."""
_CONTRADICTIONS = 2
"""Number of consecutive spans of arrivals that determine or correct the unit."""
_NS = 1_000_000_000


class TickUnit:
    """Determines the unit from groups, and corrects it if the arrivals contradict it.

    Parameters
    ----------
    rate_hz : float
        Configured sample rate, Hz.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._tick_ns: int | None = None
        self.ticks_per_s: float | None = None
        """Most recently measured rate, ticks/s; None before ten steps."""
        self.restart()

    def restart(self) -> None:
        """Discard the groups but not the unit, because the device restarted."""
        self._last: tuple[int, int | None] | None = None
        self._steps: list[float] = []  # ticks per sample
        self._since_ns: int | None = None
        self._span_ticks = self._contradictions = 0

    def feed(self, ticks: int, counter: int | None, t_ns: int) -> int | None:
        """Add a group and return the duration of a tick.

        Parameters
        ----------
        ticks : int
            SampleTime of the group.
        counter : int, optional
            GroupCounter of the group.
        t_ns : int
            Arrival time of the group, ns.

        Returns
        -------
        int or None
            Duration of a tick, 1 000 or 100 000 ns; None while it is not determined.
        """
        last, self._last = self._last, (ticks, counter)
        if last is None or self._since_ns is None:
            self._since_ns = t_ns
            return self._tick_ns

        step = (ticks - last[0]) % TICKS_MODULUS
        self._span_ticks += step
        if self._tick_ns is None:
            before, samples = last[1], 1
            if counter is not None and before is not None:
                samples = (counter - before) % COUNTER_MODULUS
            if samples and len(self._steps) < _STEPS:
                self._steps.append(step / samples)
                if len(self._steps) == _STEPS:
                    self._tick_ns = self._nearest(median(self._steps) * self._rate_hz)

        if t_ns - self._since_ns >= _SPAN_NS:
            self._end_span(t_ns)
        return self._tick_ns

    def _end_span(self, t_ns: int) -> None:
        """Compare the unit with the arrivals since the previous call."""
        elapsed_ns, ticks = t_ns - (self._since_ns or 0), self._span_ticks
        self._since_ns, self._span_ticks = t_ns, 0

        if len(self._steps) < _STEPS and self._tick_ns is None:
            return
        measured = self._nearest(ticks * _NS / elapsed_ns)
        if measured is None or measured == self._tick_ns:
            self._contradictions = 0
            return
        self._contradictions += 1
        if self._contradictions >= _CONTRADICTIONS:
            self._tick_ns, self._contradictions = measured, 0

    def _nearest(self, ticks_per_s: float) -> int | None:
        """Return the duration of a tick, ns, in the unit whose rate is near `ticks_per_s`."""
        if ticks_per_s <= 0:
            return None
        self.ticks_per_s = ticks_per_s
        for tick_ns in TICK_NS.values():
            if abs(log10(ticks_per_s * tick_ns / _NS)) < _NEAR:
                return tick_ns
        return None
