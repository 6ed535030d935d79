"""Host time that is not estimated from the arrivals of the samples (*direct time*).

Direct time comes from sync edges with two timestamps, or from a device clock that is declared to be
the host clock. It takes precedence over estimates from arrivals. If a settled estimate contradicts
the direct time, the direct time is discarded and a warning is published.

A sync edge is one instant with two timestamps: u on the device clock, v on the reference clock. The
line ``v(u)`` through the edges of the last minute relates the two clocks with an accuracy of
microseconds. The line converts u to v, and the reference clock converts v to host time. The error
of the reference clock, including its minimum delay, is then common to both clocks, and cancels in
differences between their host times.
"""

from __future__ import annotations

from collections import deque
from math import hypot, inf, sqrt
from typing import TYPE_CHECKING, NamedTuple, Protocol

from jointfit_daemon.timing.clock._line_fit import FittedLine, fit_line

if TYPE_CHECKING:
    from jointfit_daemon.model import TickClock

EDGE_SD_NS = 1_000.0
"""Standard deviation of an edge's timestamp in addition to tick quantization, ns."""
SYNC_SKEW_SD = 100e-6
"""Prior standard deviation of the relative skew of two clocks, dimensionless."""
SYNC_STALE_NS = 20_000_000_000
"""Age of the last edge after which the fit is unusable, ns."""
KNOWN_SD_NS = 10_000.0
"""Standard deviation of a clock declared to be the host clock, ns."""
MARGIN_NS = 3_000_000
"""Largest accepted difference of a direct time from the estimate, ns, in addition to the
uncertainties of the estimate and of the minimum delay."""
LATEST_NS = 2_000_000_000
"""Largest delay of a live sample, ns."""

_LEAST_PAIRS = 5
"""Least number of edges of a usable fit."""
_CAPACITY = 120
"""Largest number of edges in memory."""
_SPACING_NS = 500_000_000
"""Least interval between two edges in memory, ns."""
_STRAY_NS = 500_000
"""Residual above which an edge is an outlier, ns."""
_STRAYS = 5
"""Number of successive outliers that invalidates the fit."""


class HostTime(Protocol):
    """A clock with a conversion to host time."""

    epoch: int

    @property
    def slope(self) -> float:
        """Derivative of host time minus own time with respect to own time, dimensionless."""

    @property
    def settled(self) -> bool:
        """Whether ``host_ns`` is valid."""

    def host_ns(self, u: int) -> int:
        """Return the host time at time `u` of this clock, ns."""

    def sigma_at(self, u: int) -> float:
        """Return the standard deviation of ``host_ns(u)``, ns."""


class DeclaredOffset(NamedTuple):
    """A device clock that differs from the host clock by a known offset."""

    offset_ns: int
    """Host time minus device time, ns."""
    slope: float = 0.0

    def usable(self, u: int) -> bool:  # noqa: ARG002 - the offset is constant
        """Return True, because the offset is always known."""
        return True

    def host_ns(self, u: int) -> int:
        """Return the host time of device time `u`, ns."""
        return u + self.offset_ns

    def sigma_at(self, u: int) -> float:  # noqa: ARG002 - the same at all times
        """Return the standard deviation of ``host_ns(u)``, ns."""
        return KNOWN_SD_NS


class SyncEdgeFit:
    """Relation of two clocks, fitted to edges with timestamps of both clocks.

    Parameters
    ----------
    reference : HostTime
        Clock to which the device clock is related.
    grain_ns : float
        Tick length of the device clock, ns.
    """

    __slots__ = ("_epoch", "_line", "_pairs", "_ref", "_strays", "_variance", "reference")

    def __init__(self, reference: HostTime, grain_ns: float = 0.0) -> None:
        self.reference = reference
        self._epoch = reference.epoch
        self._pairs: deque[tuple[int, int]] = deque(maxlen=_CAPACITY)
        self._line = FittedLine(0.0, 0.0, inf, 0.0, SYNC_SKEW_SD**2)
        self._ref = (0, 0)
        self._variance = EDGE_SD_NS**2 + grain_ns**2 / 12
        self._strays = 0

    @property
    def slope(self) -> float:
        """Derivative of host time minus device time with respect to device time, dimensionless."""
        return self._line.slope + self.reference.slope

    @property
    def broken(self) -> bool:
        """Whether the reference restarted or several edges in a row were outliers."""
        return self._strays >= _STRAYS or self.reference.epoch != self._epoch

    def feed(self, u: int, v: int) -> None:
        """Add an edge with device time `u` and reference time `v`, ns. Edges must be in order."""
        pairs = self._pairs
        stray = len(pairs) >= _LEAST_PAIRS and abs(v - self._reference_ns(u)) > _STRAY_NS
        self._strays = self._strays + 1 if stray else 0
        if stray or (len(pairs) >= _LEAST_PAIRS and u - pairs[-1][0] < _SPACING_NS):
            return
        pairs.append((u, v))

        u0, v0 = self._ref = pairs[0]
        weight = 1.0 / self._variance
        rows = [(float(a - u0), float(b - v0 - (a - u0)), weight) for a, b in pairs]
        self._line = fit_line(rows, SYNC_SKEW_SD)

    def usable(self, u: int) -> bool:
        """Return whether the fit is valid at device time `u`."""
        pairs = self._pairs
        return (
            len(pairs) >= _LEAST_PAIRS
            and u - pairs[-1][0] <= SYNC_STALE_NS
            and self.reference.epoch == self._epoch
            and self.reference.settled
        )

    def _reference_ns(self, u: int) -> int:
        u0, v0 = self._ref
        return v0 + u - u0 + round(self._line.height + self._line.slope * (u - u0))

    def host_ns(self, u: int) -> int:
        """Return the host time of device time `u`, ns."""
        return self.reference.host_ns(self._reference_ns(u))

    def sigma_at(self, u: int) -> float:
        """Return the standard deviation of ``host_ns(u)``, ns.

        It includes the standard deviation of the reference.
        """
        own = sqrt(self._line.variance_at(u - self._ref[0]))
        return hypot(own, self.reference.sigma_at(self._reference_ns(u)))


DirectTime = DeclaredOffset | SyncEdgeFit
"""A conversion from device to host time that does not use the arrivals of the samples."""


def declared_offset(clock: TickClock, unix_offset_ns: int | None) -> DeclaredOffset | None:
    """Return the conversion of a clock declared to be the host clock, or None for other clocks.

    Parameters
    ----------
    clock : TickClock
        Clock of the device as declared by its decoder.
    unix_offset_ns : int or None
        UNIX time minus CLOCK_MONOTONIC, ns; None while unknown.
    """
    if clock.scale == "monotonic":
        return DeclaredOffset(0)
    if clock.scale == "unix" and unix_offset_ns is not None:
        return DeclaredOffset(-unix_offset_ns)
    return None


def possible(t_ns: int, arrival_ns: int) -> bool:
    """Return whether a sample taken at `t_ns` may arrive at `arrival_ns`."""
    return -MARGIN_NS <= arrival_ns - t_ns <= LATEST_NS
