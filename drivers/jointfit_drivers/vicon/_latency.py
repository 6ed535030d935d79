"""Delay from exposure to arrival: announced processing time plus half the round trip of a ping.

The server sends neither the time of exposure nor a clock. LatencyInfo contains the durations of the
processing stages, and the round-trip time of a ping is an upper bound of the network delay.

Invariant: the module is pure.
"""

from __future__ import annotations

import statistics
from collections import deque
from typing import TYPE_CHECKING

from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from jointfit_protocols.vicon import LatencyInfo

_LONGEST_S = 1.0
"""Longest plausible sum of the durations of the stages, and longest round-trip time of a ping that
is used, s."""
_SUMS = 101
"""Number of recent frames from which the median of the sums is computed."""
_PINGS = 20
_EVERY = 32
"""Number of frames between two computations of the median."""


class AnnouncedLatency:
    """Median of the announced delay, and half the mean round-trip time of pings."""

    def __init__(self) -> None:
        self._sums_ns: deque[int] = deque(maxlen=_SUMS)
        self._round_trips_ns: deque[int] = deque(maxlen=_PINGS)
        self._frames = 0
        self.delay_ns = 0
        """Announced delay of processing, plus the delay of the network, ns."""

    @property
    def announced(self) -> bool:
        """Whether the server announces the durations of its stages."""
        return bool(self._sums_ns)

    @property
    def uncertainty_ns(self) -> int:
        """Standard deviation of the sums, plus half of the mean round-trip time, ns."""
        spread = statistics.pstdev(self._sums_ns) if len(self._sums_ns) > 1 else 0.0
        return round(self._half_trip_ns + spread)

    @property
    def _half_trip_ns(self) -> float:
        return statistics.mean(self._round_trips_ns) / 2 if self._round_trips_ns else 0.0

    def add_frame(self, latency: LatencyInfo | None) -> None:
        """Add the durations of the stages for one frame."""
        if latency is not None:
            total = sum(seconds for _, seconds in latency.stages)
            if 0 <= total <= _LONGEST_S:
                self._sums_ns.append(round(total * NS_PER_S))
        if self._frames % _EVERY == 0:
            median = statistics.median(self._sums_ns) if self._sums_ns else 0
            self.delay_ns = round(median + self._half_trip_ns)
        self._frames += 1

    def add_ping(self, sent_ns: int, arrival_ns: int) -> None:
        """Add the answer to a ping that was sent at `sent_ns`."""
        if 0 <= arrival_ns - sent_ns <= _LONGEST_S * NS_PER_S:
            self._round_trips_ns.append(arrival_ns - sent_ns)
