"""Device time to host time, one clock a device, one stamp a sample.

Law: pure and streaming. Inputs are what a decoder yields, in order of arrival; nothing here reads a
clock. A few microseconds a sample, no memory that grows.

The model is ``t(u) = u + c + s (u - u_0)``, u the device time in ns. Where a device answers echoes
(``echo_clock``) c is known to half the asymmetry of the path; elsewhere the line under the fastest
arrivals (``envelope``) is used, which leaves the smallest delay D_min inside c: part of it may be
configured away (`latency_ns`), the rest is found as lag from motion (``lag``).

Stamps never run backwards. Once synced they are slewed by at most 500 ppm; an error too big for
that (5 ms) is a step and begins a new epoch. A new epoch says: do not join what is before with what
is after.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.timing.device_time import ArrivalTime, CounterTime, TickTime
from jointfit_daemon.timing.echo_clock import STALE_NS, EchoFit
from jointfit_daemon.timing.envelope import CRYSTAL, NOMINAL_RATE, Envelope

if TYPE_CHECKING:
    from jointfit_daemon.model import ClockEcho, TickClock
    from jointfit_daemon.timing.device_time import DeviceTime

STEP_NS = 5_000_000
"""Error that is not slewed away, and by how much data may come before its time: then a restart."""
SLEW = 500e-6
LATE_NS = 50_000_000
LATE_FOR_NS = 2_000_000_000
LATE_SIGMAS = 20.0
ABSENT_LIMIT = 100
"""Samples in a row without the time they used to carry, before the clock does without it."""

_ARRIVAL, _COUNTER, _TICKS = range(3)
_JITTER_GAIN = 0.01
_ARRIVAL_SIGMA = 0.1


class Stamp(NamedTuple):
    """Host time of a sample, and what it is worth."""

    t_ns: int
    """Host CLOCK_MONOTONIC, ns; greater than the stamp before, unless reordered or duplicate."""
    sigma_ns: float
    """Standard deviation, ns; the unseen smallest delay is not in it. May be inf at first."""
    synced: bool
    """False while the clock settles."""
    epoch: int
    """Grows whenever time before and after do not belong together."""
    duplicate: bool = False
    """The device gave this sample the time of the one before."""


class DeviceClock:
    """Clock of one device, by the best its samples offer: echoes, ticks, a counter, or nothing.

    Parameters
    ----------
    period_ns : int
        Nominal time between two samples, ns.
    latency_ns : int
        Known smallest delay from sampled instant to arrival, ns; subtracted where arrivals rule.
    """

    __slots__ = (
        "_absent", "_arrival_ns", "_echo", "_envelope", "_kind", "_last_t", "_last_u",
        "_late_since", "_latency_ns", "_newest_t", "_period_ns", "_reader", "_synced",
        "_tick_clock", "epoch", "jitter_ns", "sigma_ns",
    )  # fmt: skip

    def __init__(self, period_ns: int, *, latency_ns: int = 0) -> None:
        self.epoch = 0
        self.sigma_ns: float | None = None
        """Sigma of the last stamp, ns; None before any."""
        self.jitter_ns: float | None = None
        """Mean delay beyond the fastest sample (with echoes: beyond the sampled instant), ns."""
        self._period_ns, self._latency_ns = period_ns, latency_ns
        self._last_t: int | None = None
        self._newest_t: int | None = None  # of all stamps, also those without device time
        self._arrival_ns = 0
        self._tick_clock: TickClock | None = None
        self._kind, self._absent = _ARRIVAL, 0
        self._forget()

    def _forget(self) -> None:
        """Begin to settle anew. The last stamp stays, for time never runs backwards."""
        self._reader: DeviceTime | None = None
        self._envelope = Envelope(CRYSTAL)
        self._echo: EchoFit | None = None
        self._last_u: int | None = None
        self._late_since: int | None = None
        self._synced = False

    # --- what is known -----------------------------------------------------------------------

    @property
    def state(self) -> str:
        """Return ``settling``, ``passive``, ``echo``, ``arrival`` (no device time) or ``stale``."""
        if not self._synced:
            return "settling"
        echo = self._echo
        if echo is not None and echo.settled and echo.last_ns is not None:
            return "stale" if self._arrival_ns - echo.last_ns > STALE_NS else "echo"
        return "arrival" if self._kind == _ARRIVAL else "passive"

    @property
    def skew_ppm(self) -> float | None:
        """Return s in 1e-6, positive when the device clock runs slow; None while settling."""
        if not self._synced:
            return None
        slope = self._envelope.skew if self._echo is None else -self._echo.slope
        return 1e6 * slope

    @property
    def offset_ns(self) -> int | None:
        """Return host minus device time at the last sample, ns; None before any."""
        if self._last_t is None or self._last_u is None:
            return None
        return self._last_t - self._last_u

    @property
    def bound_ns(self) -> float | None:
        """Return the hard limit of the unseen constant, ns; None where nothing limits it."""
        return None if self._echo is None else self._echo.bound_ns

    # --- what comes in -----------------------------------------------------------------------

    def feed_restart(self) -> None:
        """Take it that the device's clock began anew, or may have."""
        if self._last_u is not None or self._echo is not None:
            self.epoch += 1
        self._forget()

    def feed_echo(self, echo: ClockEcho, tick_clock: TickClock | None = None) -> None:
        """Take an answered echo. Ignored while nobody knows how the device counts."""
        tick_clock = tick_clock or self._tick_clock
        if tick_clock is None:
            return
        reader = self._ticks_reader(tick_clock)
        u = reader.echo_ns(echo.ticks)
        if self._echo is None:
            self._echo = EchoFit()
        elif self._echo.contradicts(u, echo.sent_ns, echo.received_ns):
            self.feed_restart()
            reader = self._ticks_reader(tick_clock)
            u = reader.echo_ns(echo.ticks)
            self._echo = EchoFit()
        self._echo.feed(u, echo.sent_ns, echo.received_ns)

    def feed_sample(
        self,
        ticks: int | None,
        counter: int | None,
        arrival_ns: int,
        tick_clock: TickClock | None = None,
    ) -> Stamp:
        """Return the host time of a sample.

        Parameters
        ----------
        ticks, counter : int or None
            Device time and sequence number as sent.
        arrival_ns : int
            Host time of the first byte, ns.
        tick_clock : TickClock or None
            How `ticks` count; ticks without it are no time.
        """
        reader = self._reader_for(ticks, counter, tick_clock)
        self._arrival_ns = arrival_ns
        if reader is None:
            return self._by_arrival(arrival_ns)
        u = reader.feed(ticks, counter, arrival_ns, self._envelope)
        if u is None or self._impossible(u, arrival_ns):
            u = self._restarted(ticks, counter, arrival_ns, tick_clock)
        last_u = self._last_u
        if last_u is not None and u <= last_u:
            return self._past(u, last_u)
        return self._stamp(u, arrival_ns)

    # --- which time --------------------------------------------------------------------------

    def _ticks_reader(self, tick_clock: TickClock) -> TickTime:
        reader = self._reader
        if not isinstance(reader, TickTime) or tick_clock != self._tick_clock:
            if reader is not None:
                self.feed_restart()
            self._tick_clock, self._kind = tick_clock, _TICKS
            self._reader = reader = TickTime(tick_clock)
        return reader

    def _reader_for(
        self, ticks: int | None, counter: int | None, tick_clock: TickClock | None
    ) -> DeviceTime | None:
        """Return the reader of the best time on offer; None for a sample without the usual one."""
        if ticks is not None and tick_clock is not None:
            self._absent = 0
            return self._ticks_reader(tick_clock)
        kind = _ARRIVAL if counter is None else _COUNTER
        reader = self._reader
        if reader is not None and kind == self._kind:
            self._absent = 0
            return reader
        if reader is not None:
            self._absent += 1
            if kind < self._kind and self._absent < ABSENT_LIMIT:
                return None
            self.feed_restart()
        self._kind, self._absent = kind, 0
        self._envelope = Envelope(NOMINAL_RATE)
        make = ArrivalTime if kind == _ARRIVAL else CounterTime
        self._reader = reader = make(self._period_ns)
        return reader

    def _restarted(
        self, ticks: int | None, counter: int | None, arrival_ns: int, tick_clock: TickClock | None
    ) -> int:
        self.feed_restart()
        reader = self._reader_for(ticks, counter, tick_clock)
        u = None if reader is None else reader.feed(ticks, counter, arrival_ns, self._envelope)
        return arrival_ns if u is None else u

    # --- what does not fit -------------------------------------------------------------------

    def _impossible(self, u: int, arrival_ns: int) -> bool:
        """Tell whether the sample contradicts the fit: it came before its time, or stays late."""
        last_u = self._last_u
        if last_u is None or u <= last_u:
            return False
        echo = self._echo
        if echo is not None and echo.settled:
            return arrival_ns - echo.host_ns(u) < -STEP_NS
        envelope = self._envelope
        excess = envelope.residual(u, arrival_ns - u)
        if excess < -STEP_NS:
            if envelope.settled:
                return True
            # What came before was merely late, by seconds perhaps (stale bytes): no use for a fit.
            self._envelope = Envelope(NOMINAL_RATE if self._kind != _TICKS else CRYSTAL)
            return False
        if not envelope.settled or excess < LATE_NS or excess < LATE_SIGMAS * envelope.sigma_ns(u):
            self._late_since = None
            return False
        if self._late_since is None:
            self._late_since = arrival_ns
        return arrival_ns - self._late_since > LATE_FOR_NS

    # --- stamps ------------------------------------------------------------------------------

    def _stamp(self, u: int, arrival_ns: int) -> Stamp:
        echo, envelope = self._echo, self._envelope
        if echo is not None and echo.settled:
            target, skew, settled = echo.host_ns(u), -echo.slope, True
            delay, sigma = float(arrival_ns - target), echo.sigma_ns(target)
        else:
            delay = abs(envelope.feed(u, arrival_ns - u))
            target = u + envelope.offset_ns(u) - self._latency_ns
            skew, settled, sigma = envelope.skew, envelope.settled, envelope.sigma_ns(u)
            if self._kind == _ARRIVAL:
                sigma = max(sigma, _ARRIVAL_SIGMA * self._period_ns)
        jitter = self.jitter_ns
        self.jitter_ns = delay if jitter is None else jitter + _JITTER_GAIN * (delay - jitter)
        t = self._forward(self._slewed(u, target, skew))
        self._last_u, self._last_t = u, t
        self._synced = settled
        self.sigma_ns = sigma = sigma + abs(t - target)
        return Stamp(t, sigma, settled, self.epoch)

    def _slewed(self, u: int, target: int, skew: float) -> int:
        """Return the stamp nearest to `target` that neither runs backwards nor jumps."""
        last_t, last_u = self._last_t, self._last_u
        if last_t is None or last_u is None:
            return target
        step = u - last_u
        if not self._synced:
            return max(target, last_t + min(step, self._period_ns) // 2)
        expected = last_t + step + round(skew * step)
        error, limit = target - expected, round(SLEW * step)
        if abs(error) > max(STEP_NS, limit):
            self.epoch += 1
            return target
        return expected + max(-limit, min(error, limit))

    def _forward(self, t: int) -> int:
        """Return `t`, or the first instant after every stamp given so far."""
        if self._newest_t is not None and t <= self._newest_t:
            t = self._newest_t + 1
        self._newest_t = t
        return t

    def _past(self, u: int, last_u: int) -> Stamp:
        """Stamp a duplicate (u = last) or reordered sample; it teaches nothing."""
        last_t = last_u if self._last_t is None else self._last_t
        sigma = inf if self.sigma_ns is None else self.sigma_ns
        return Stamp(last_t - (last_u - u), sigma, self._synced, self.epoch, u == last_u)

    def _by_arrival(self, arrival_ns: int) -> Stamp:
        """Stamp a sample that lacks the time its neighbours have."""
        t = arrival_ns - self._latency_ns - round(self.jitter_ns or 0.0)
        return Stamp(self._forward(t), float(self._period_ns), synced=False, epoch=self.epoch)
