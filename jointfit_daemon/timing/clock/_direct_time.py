"""Time that needs no statistics: edges two clocks both saw, and clocks that are the host's own.

Law: pure; constant memory. A direct time beats every estimate from arrivals, and an estimate that
contradicts it makes an event of it (``clock``).

A sync pulse is one instant with two names: u on the device's clock, v on the reference's. The line
``v(u)`` through the pulses of the last minute ties the two clocks to microseconds, and whatever
maps v to host time then maps u as well: what is unsure about that mapping is shared by both, so it
drops out of every difference between them, and no smallest delay is left in it.
"""

from __future__ import annotations

from collections import deque
from math import hypot, inf, sqrt
from typing import TYPE_CHECKING, NamedTuple, Protocol

from jointfit_daemon.timing.clock._line_fit import FittedLine, fit_line

if TYPE_CHECKING:
    from jointfit_daemon.model import TickClock

EDGE_SD_NS = 1_000.0
"""Standard deviation of an edge's stamp beside the grain of the device's ticks."""
TIE_SKEW_SD = 100e-6
"""Prior standard deviation of the speed of one clock against another."""
TIE_STALE_NS = 20_000_000_000
KNOWN_SD_NS = 10_000.0
"""What a clock that is declared to be the host's is believed to."""
MARGIN_NS = 3_000_000
"""How far beyond its prior the smallest delay may be before a direct time is doubted."""
LATEST_NS = 2_000_000_000
"""Nothing live comes later than this."""

_LEAST_PAIRS = 5
_CAPACITY = 120
_SPACING_NS = 500_000_000
_STRAY_NS = 500_000
_STRAYS = 5


class HostTime(Protocol):
    """A clock whose time can be told in host time."""

    epoch: int

    @property
    def slope(self) -> float:
        """d(host - own) / d own."""

    @property
    def settled(self) -> bool:
        """Whether ``host_ns`` means anything yet."""

    def host_ns(self, u: int) -> int:
        """Return the host time of the clock's own time `u`, ns."""

    def sigma_at(self, u: int) -> float:
        """Return the standard deviation of ``host_ns(u)``, ns."""


class Direct(Protocol):
    """A way from device to host time that does not look at arrivals."""

    @property
    def slope(self) -> float:
        """d(host - device) / d device."""

    def usable(self, u: int) -> bool:
        """Tell whether it holds at device time `u`."""

    def host_ns(self, u: int) -> int:
        """Return the host time of device time `u`, ns."""

    def sigma_at(self, u: int) -> float:
        """Return the standard deviation of ``host_ns(u)``, ns."""


class KnownOffset(NamedTuple):
    """The device's clock is the host's, but for an offset the host knows."""

    offset_ns: int
    """Host time minus device time."""
    slope: float = 0.0

    def usable(self, u: int) -> bool:  # noqa: ARG002 - it always is
        """Return True."""
        return True

    def host_ns(self, u: int) -> int:
        """Return the host time of device time `u`, ns."""
        return u + self.offset_ns

    def sigma_at(self, u: int) -> float:  # noqa: ARG002 - the same at all times
        """Return the standard deviation of ``host_ns(u)``, ns."""
        return KNOWN_SD_NS


class PulseTie:
    """Ties one clock to another by the edges both stamped.

    Parameters
    ----------
    reference : HostTime
        The other clock.
    grain_ns : float
        Both clocks' ticks, ns, as one root of a sum of squares: an edge falls anywhere in a tick.
    """

    __slots__ = ("_epoch", "_line", "_pairs", "_ref", "_strays", "_variance", "reference")

    def __init__(self, reference: HostTime, grain_ns: float = 0.0) -> None:
        self.reference = reference
        self._epoch = reference.epoch
        self._pairs: deque[tuple[int, int]] = deque(maxlen=_CAPACITY)
        self._line = FittedLine(0.0, 0.0, inf, 0.0, TIE_SKEW_SD**2)
        self._ref = (0, 0)
        self._variance = EDGE_SD_NS**2 + grain_ns**2 / 12
        self._strays = 0

    @property
    def slope(self) -> float:
        """d(host - device) / d device."""
        return self._line.slope + self.reference.slope

    @property
    def pairs(self) -> int:
        """Edges the line rests on."""
        return len(self._pairs)

    @property
    def broken(self) -> bool:
        """Whether the reference began anew, or edge after edge was off the line: of no more use."""
        return self._strays >= _STRAYS or self.reference.epoch != self._epoch

    def feed(self, u: int, v: int) -> None:
        """Take an edge: device time and reference time, ns, in order."""
        pairs = self._pairs
        stray = len(pairs) >= _LEAST_PAIRS and abs(v - self._reference_ns(u)) > _STRAY_NS
        self._strays = self._strays + 1 if stray else 0
        if stray or (len(pairs) >= _LEAST_PAIRS and u - pairs[-1][0] < _SPACING_NS):
            return
        pairs.append((u, v))
        u0, v0 = self._ref = pairs[0]
        weight = 1.0 / self._variance
        rows = [(float(a - u0), float(b - v0 - (a - u0)), weight) for a, b in pairs]
        self._line = fit_line(rows, TIE_SKEW_SD)

    def usable(self, u: int) -> bool:
        """Tell whether the tie holds at device time `u`."""
        pairs = self._pairs
        return (
            len(pairs) >= _LEAST_PAIRS
            and u - pairs[-1][0] <= TIE_STALE_NS
            and self.reference.epoch == self._epoch
            and self.reference.settled
        )

    def _reference_ns(self, u: int) -> int:
        u0, v0 = self._ref
        return v0 + u - u0 + round(self._line.height + self._line.slope * (u - u0))

    def host_ns(self, u: int) -> int:
        """Return the host time of device time `u`, ns."""
        return self.reference.host_ns(self._reference_ns(u))

    def tie_sigma_at(self, u: int) -> float:
        """Return the standard deviation between device and reference at `u`, ns."""
        return sqrt(self._line.variance_at(u - self._ref[0]))

    def sigma_at(self, u: int) -> float:
        """Return the standard deviation of ``host_ns(u)``, ns, the reference's included."""
        return hypot(self.tie_sigma_at(u), self.reference.sigma_at(self._reference_ns(u)))


def declared(clock: TickClock, unix_offset_ns: int | None) -> KnownOffset | None:
    """Return the way to host time of a clock that is declared to be the host's; None if it is not.

    Parameters
    ----------
    clock : TickClock
        What the decoder says of the device's clock.
    unix_offset_ns : int or None
        UNIX time minus CLOCK_MONOTONIC, ns; None while unknown.
    """
    if clock.scale == "monotonic":
        return KnownOffset(0)
    if clock.scale == "unix" and unix_offset_ns is not None:
        return KnownOffset(-unix_offset_ns)
    return None


def possible(t_ns: int, arrival_ns: int) -> bool:
    """Tell whether something taken at `t_ns` may have arrived at `arrival_ns`, ns."""
    return -MARGIN_NS <= arrival_ns - t_ns <= LATEST_NS
