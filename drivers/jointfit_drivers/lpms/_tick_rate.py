"""Check of the configured unit of device time against the arrival times.

The number of ticks per second of each model was not verified on hardware, and old firmware sends
seconds instead of ticks. A comparison with the arrivals of several seconds reveals a wrong number
of ticks and a wrong unit.

Invariant: the result depends only on ticks and arrival stamps.
"""

from __future__ import annotations

from typing import NamedTuple

from jointfit_daemon.units import NS_PER_S
from jointfit_protocols.lpms.measurement import TICK_MODULUS, seconds_of

_SPAN_NS = 3_000_000_000
"""Shortest span of arrivals that permits a measurement of the rate, ns."""
_CONTRADICTIONS = 2
"""Number of consecutive spans that prove another unit."""
_NEAR = 0.05
"""Largest relative deviation of a measured rate from the rate that it confirms."""
_MOST_RATIO = 4.0
"""Largest factor between the measured and the configured rate, in either direction, at which an
unusual rate is reported. The stamps of a decoded file of raw bytes are closer together than arrival
times. The factor is then larger, and no rate is reported."""
_USUAL_HZ = (400, 500, 800, 1000)


class TimeUnitFault(NamedTuple):
    """Finding that the unit of device time differs from the configured unit."""

    ticks_per_s: float
    """Measured rate of the number that the device sends, 1/s."""
    usual_hz: int | None
    """Usual tick rate near the measured rate; None if no usual rate is near."""
    is_seconds: bool
    """Whether the device sends float32 seconds."""


class TickRateCheck:
    """Compares the device time of one sensor with its arrivals until the unit is certain.

    Parameters
    ----------
    ticks_per_s : int
        Configured tick rate, 1/s; not used if `is_seconds` is true.
    is_seconds : bool
        Whether the configured unit is float32 seconds.
    """

    def __init__(self, ticks_per_s: int, *, is_seconds: bool) -> None:
        self._ticks_per_s, self._is_seconds = ticks_per_s, is_seconds
        self._since: tuple[int, int] | None = None
        self._contradictions = 0
        self.done = False
        """Whether the check has ended, with or without a fault."""

    def feed(self, tick: int, arrival_ns: int) -> TimeUnitFault | None:
        """Add a data packet. Return the fault once, as soon as it is certain, and None otherwise.

        Parameters
        ----------
        tick : int
            Device time as sent, 32 bits.
        arrival_ns : int
            Arrival time of the data packet, ns.
        """
        if self._since is None:
            self._since = (tick, arrival_ns)
        first, since_ns = self._since
        if arrival_ns - since_ns < _SPAN_NS:
            return None
        self._since = (tick, arrival_ns)

        elapsed_s = (arrival_ns - since_ns) / NS_PER_S
        seconds = (seconds_of(tick) - seconds_of(first)) / elapsed_s
        ticks = (tick - first) % TICK_MODULUS / elapsed_s
        if abs(seconds - 1 if self._is_seconds else ticks / self._ticks_per_s - 1) <= _NEAR:
            self.done = True
            return None

        # A restart of the device or a pause of this host causes at most one wrong span.
        self._contradictions += 1
        if self._contradictions < _CONTRADICTIONS:
            return None
        self.done = True
        usual_hz = next((hz for hz in _USUAL_HZ if abs(ticks / hz - 1) <= _NEAR), None)
        sends_seconds = abs(seconds - 1) <= _NEAR
        if not (usual_hz or sends_seconds or self._is_seconds):
            ratio = ticks / self._ticks_per_s
            if not 1 / _MOST_RATIO <= ratio <= _MOST_RATIO:
                return None
        return TimeUnitFault(ticks, usual_hz, sends_seconds)
