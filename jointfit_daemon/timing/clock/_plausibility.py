"""Detection of samples that are too early or permanently late relative to a fitted clock.

A wire, a queue or an overloaded host may delay samples by any amount without a clock fault. Late
samples therefore indicate a fault only if the delays of the fastest samples agree for two seconds.
They agree after a pause of the device clock, but not during congestion. A sample cannot arrive
before its sampling instant. A single early sample may have a wrong timestamp; three early samples
in a row indicate a clock jump.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.timing.clock._clock_events import early_arrival_event, late_arrival_event
from jointfit_daemon.timing.clock._stamps import STEP_NS

if TYPE_CHECKING:
    from jointfit_daemon.timing.clock._clock_events import ClockEvent

LATE_NS = 50_000_000
"""Least delay beyond the fastest samples that counts as late, ns."""
LATE_FOR_NS = 2_000_000_000
"""Duration of lateness before it is reported, ns."""
LATE_SIGMAS = 20.0
"""Least delay that counts as late, in standard deviations of the clock estimate."""
INTERVALS = 4
"""Number of intervals into which `LATE_FOR_NS` is divided. The delays of the fastest samples of the
intervals must agree.
"""
JITTER_NS = 25_000_000
"""Largest mean delay above the fastest samples, ns, that a paused clock explains."""
EARLY_SAMPLES = 3
"""Number of early samples in a row that indicates a clock jump."""

_INTERVAL_NS = LATE_FOR_NS // INTERVALS


class _LateInterval(NamedTuple):
    """Statistics of the delays of late samples within half a second, ns."""

    least: float
    total: float
    samples: int

    def with_sample(self, excess_ns: float) -> _LateInterval:
        """Return the statistics with one more sample."""
        least, total = min(self.least, excess_ns), self.total + excess_ns
        return _LateInterval(least, total, self.samples + 1)

    def agrees(self, least: float) -> bool:
        """Return whether the least delay agrees with `least`, ns, and the jitter is small."""
        return self.least - least <= STEP_NS and self.total / self.samples - least <= JITTER_NS


class PlausibilityMonitor:
    """Checks every sample of a settled clock."""

    __slots__ = ("_interval", "_intervals", "_until_ns", "any", "early")

    def __init__(self) -> None:
        self.any = False
        """Whether the last sample was implausible."""

        self.early = 0
        """Number of early samples in a row. Only the samples that follow show whether a timestamp
        was wrong or the clock jumped."""
        self._until_ns: int | None = None
        self._intervals: list[_LateInterval] = []
        self._interval = _LateInterval(0.0, 0.0, 1)

    def clear(self) -> None:
        """Record a plausible sample."""
        self.any, self.early, self._until_ns = False, 0, None

    def feed(self, excess_ns: float, sigma_ns: float, arrival_ns: int) -> ClockEvent | None:
        """Return an event if this sample completes the evidence for a clock fault.

        Parameters
        ----------
        excess_ns : float
            Delay relative to the fastest samples, ns; negative if the sample is early.
        sigma_ns : float
            Standard deviation of the clock estimate, ns.
        arrival_ns : int
            Host time of arrival, ns.
        """
        self.any = True
        if excess_ns < -STEP_NS:
            self.early += 1
            return early_arrival_event(-excess_ns) if self.early >= EARLY_SAMPLES else None

        self.early = 0
        if excess_ns < LATE_NS or excess_ns < LATE_SIGMAS * sigma_ns:
            self.clear()
            return None
        if self._until_ns is not None and arrival_ns < self._until_ns:
            self._interval = self._interval.with_sample(excess_ns)
            return None

        intervals = self._intervals
        if self._until_ns is None:
            intervals.clear()
        else:
            intervals.append(self._interval)
            del intervals[:-INTERVALS]
        self._until_ns = arrival_ns + _INTERVAL_NS
        self._interval = _LateInterval(excess_ns, excess_ns, 1)

        if len(intervals) < INTERVALS:
            return None
        least = min(interval.least for interval in intervals)
        agreed = all(interval.agrees(least) for interval in intervals)
        return late_arrival_event(least, LATE_FOR_NS / 1e9) if agreed else None
