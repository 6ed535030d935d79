"""Conversion of device time to host time, with one clock per device.

Every sample gets a timestamp, in order of arrival. The computation takes a few microseconds per
sample, and memory is constant.

The model is ``t(u) = u + c + s (u - u_0)``, where u is the device time in ns, c the offset at the
device time u_0, and s the skew. The first available source of this list is used:

1. sync edges, or a device clock declared to be the host clock (``_direct_time``);
2. echoes, which are requests that the device answers with its time (``_echo_fit``). The error of c
is then half the difference between the delays of request and reply;
3. the minimum-delay filter on arrivals (``_minimum_delay``). The error of c is then the minimum
delay D_min. The prior mean of D_min, `latency_ns`, is subtracted. The remaining delay is part of
the lag that ``timing.lag`` estimates from motion.

Timestamps never decrease. Small errors are corrected gradually (slewed, ``_stamps``). A larger
error starts a new epoch; samples of different epochs must not be combined.
"""

from __future__ import annotations

from collections import deque
from math import inf
from typing import TYPE_CHECKING

from jointfit_daemon.timing.clock import _clock_events
from jointfit_daemon.timing.clock._delay_statistics import DelayStatistics
from jointfit_daemon.timing.clock._device_time import ArrivalTime, CounterTime, TickTime
from jointfit_daemon.timing.clock._direct_time import (
    MARGIN_NS,
    SyncEdgeFit,
    declared_offset,
    possible,
)
from jointfit_daemon.timing.clock._echo_fit import STALE_NS, EchoFit
from jointfit_daemon.timing.clock._minimum_delay import CRYSTAL, NOMINAL_RATE, MinimumDelayFilter
from jointfit_daemon.timing.clock._plausibility import LATE_NS, PlausibilityMonitor
from jointfit_daemon.timing.clock._stamps import STEP_NS, MonotonicStamps, Stamp

if TYPE_CHECKING:
    from jointfit_daemon.model import ClockEcho, TickClock
    from jointfit_daemon.timing.clock._clock_events import ClockEvent
    from jointfit_daemon.timing.clock._device_time import DeviceTime
    from jointfit_daemon.timing.clock._direct_time import DirectTime, HostTime
    from jointfit_daemon.timing.clock._stamps import Estimate

ABSENT_LIMIT = 100
"""Number of consecutive samples without their usual device time before the clock changes its
source."""
CAUGHT_UP_NS = 50_000
"""Largest difference between a timestamp and its estimate at which the clock becomes synced, ns."""
AWAY_SLACK_NS = 500_000_000
"""Tolerance of the first device time after the port was closed, ns. Bytes may have been buffered
while the port was closed.
"""
AWAY_TURNS = 20
"""Least period after which the device readings repeat, in multiples of the tolerance of the first
device time after the port was closed. With a shorter period, a restart cannot be detected, because
the readings would hide it by chance in more than one of ten cases.
"""

_ARRIVAL, _COUNTER, _TICKS = range(3)
_JITTER_GAIN = 0.01
"""Gain of the running mean of the jitter."""
_ARRIVAL_SIGMA = 0.1
"""Least standard deviation of timestamps of samples that are numbered by arrival, periods."""
_PRIOR_SIGMAS = 4.0
"""Largest accepted difference between direct time and the estimate, in standard deviations."""
_AWAY_SHARES = 0.0, 0.02, 0.001
"""Fraction of the elapsed time that is added to the tolerance of the first device time after the
port was closed, for arrivals, counter and ticks."""
_SKEW_CHECK_SAMPLES = 256
"""Number of samples between two plausibility checks of the skew."""


class DeviceClock:
    """Clock of one device, estimated from sync edges, echoes, ticks, a counter, or arrivals.

    Parameters
    ----------
    period_ns : int
        Nominal sample period, ns.
    latency_ns, latency_sd_ns : int
        Prior mean and standard deviation of the minimum delay from sampling instant to arrival, ns.
        The mean is subtracted if the clock is estimated from arrivals.
    """

    __slots__ = (
        "_absent", "_arrival_ns", "_away_since_ns", "_direct", "_doubts", "_echo", "_envelope",
        "_kind", "_line", "_looked", "_period_ns", "_reader", "_refused", "_state_direct",
        "_synced", "_tick_clock", "_unix_offset_ns", "_warned", "epoch", "jitter_ns", "latency_ns",
        "latency_sd_ns", "minute", "news", "sigma_ns",
    )  # fmt: skip

    def __init__(self, period_ns: int, *, latency_ns: int = 0, latency_sd_ns: int = 0) -> None:
        self.epoch = 0
        self.sigma_ns: float | None = None
        """Standard deviation of the last timestamp, ns; None before the first timestamp."""
        self.jitter_ns: float | None = None
        """Mean delay relative to the fastest samples or, with echoes, to the sampling instant, ns.
        """
        self.latency_ns, self.latency_sd_ns = latency_ns, latency_sd_ns
        self.minute = DelayStatistics()
        """Delays from sampling instant to arrival, and the sample rate, of the last minute."""
        self.news: deque[ClockEvent] = deque(maxlen=16)
        """Events to be published. The publisher removes published events."""
        self._unix_offset_ns: int | None = None
        self._period_ns, self._line = period_ns, MonotonicStamps(period_ns)
        self._arrival_ns = 0
        self._tick_clock: TickClock | None = None
        self._kind, self._absent, self._looked, self._warned = _ARRIVAL, 0, 0, False
        self._forget()

    def _forget(self) -> None:
        """Restart the estimate, but keep the last timestamp so that timestamps never decrease."""
        self._reader: DeviceTime | None = None
        self._envelope = MinimumDelayFilter(CRYSTAL)
        self._echo: EchoFit | None = None
        self._direct: DirectTime | None = None
        self._refused = self._state_direct = self._synced = False
        self._away_since_ns: int | None = None
        """Instant of the last sample before the port was closed, ns. It is reset to None when a
        sample determines whether the device restarted.
        """
        self._line.last_u = None
        self._doubts = PlausibilityMonitor()

    # --- state -------------------------------------------------------------------------------

    @property
    def state(self) -> str:
        """Source of the timestamps.

        The values are ``settling`` (no settled estimate yet), ``direct`` (sync edges, or a clock
        declared to be the host clock), ``echo`` (echoes), ``passive`` (device time and arrivals),
        ``arrival`` (arrivals without device time) and ``stale`` (echoes that stopped).
        """
        if not self._synced:
            return "settling"
        if self._state_direct:
            return "direct"
        echo = self._echo
        if echo is not None and echo.settled and echo.last_ns is not None:
            return "stale" if self._arrival_ns - echo.last_ns > STALE_NS else "echo"
        return "arrival" if self._kind == _ARRIVAL else "passive"

    @property
    def skew_ppm(self) -> float | None:
        """Skew s, ppm, positive when the device clock runs slow; None while settling."""
        if not self._synced:
            return None
        direct = self._direct if self._state_direct else None
        return 1e6 * (self.slope if direct is None else direct.slope)

    @property
    def slope(self) -> float:
        """Skew s from echoes or arrivals, dimensionless."""
        return self._envelope.skew if self._echo is None else -self._echo.slope

    @property
    def offset_ns(self) -> int | None:
        """Host time minus device time at the last sample, ns; None before the first sample."""
        return self._line.offset_ns

    @property
    def bound_ns(self) -> float | None:
        """Limit of the constant error of the offset, ns; None without echoes."""
        return None if self._echo is None else self._echo.bound_ns

    @property
    def last_u(self) -> int | None:
        """Device time of the newest sample, ns; None before the first sample."""
        return self._line.last_u

    @property
    def settled(self) -> bool:
        """Whether ``host_ns`` is valid."""
        return self._synced

    def host_ns(self, u: int) -> int:
        """Return the host time of device time `u` from echoes or arrivals, ns; not slewed."""
        echo = self._echo
        if echo is not None and echo.settled:
            return echo.host_ns(u)
        return u + self._envelope.offset_ns(u) - self.latency_ns

    def sigma_at(self, u: int) -> float:
        """Return the standard deviation of ``host_ns(u)``, ns."""
        echo = self._echo
        if echo is not None and echo.settled:
            return echo.sigma_ns(echo.host_ns(u))
        return self._envelope.sigma_ns(u)

    # --- input -------------------------------------------------------------------------------

    def feed_restart(self) -> None:
        """Restart the clock after a reported or possible restart of the device."""
        self._begin(None)

    def feed_reopened(self) -> None:
        """Record that the port was reopened; the next sample shows whether the device restarted."""
        # The sampling instant is used, because the arrival of the last sample may have been
        # delayed.
        last_t = self._line.last_t if self._synced else None
        self._away_since_ns = self._arrival_ns if last_t is None else last_t
        if isinstance(self._reader, TickTime):
            self._reader.forget_counter()

    def _begin(self, news: ClockEvent | None) -> None:
        away = self._away_since_ns is not None
        if away and news is not None and news.kind != "restart":
            news = _clock_events.as_restart_event(news)
        if away or self._line.last_u is not None or self._echo is not None:
            self.epoch += 1
            if news is not None and (
                self._synced or news is not _clock_events.CLOCK_SOURCE_CHANGED
            ):
                self.news.append(news)
        self._forget()

    def feed_unix_offset(self, offset_ns: int) -> None:
        """Set UNIX time minus CLOCK_MONOTONIC, ns, for clocks declared to be UNIX time."""
        if offset_ns != self._unix_offset_ns:
            self._unix_offset_ns = offset_ns
            if self._tick_clock is not None and self._tick_clock.scale == "unix":
                self._refused = False
                self._direct = declared_offset(self._tick_clock, offset_ns)

    def feed_echo(self, echo: ClockEcho, tick_clock: TickClock | None = None) -> None:
        """Add an answered echo; it is ignored while the tick rate of the device is unknown."""
        tick_clock = tick_clock or self._tick_clock
        if tick_clock is None:
            return
        u = self._ticks_reader(tick_clock).echo_ns(echo.ticks)
        if self._echo is None:
            self._echo = EchoFit()
        elif self._echo.contradicts(u, echo.sent_ns, echo.received_ns):
            if not self._echo.confirms_restart(u, echo.sent_ns, echo.received_ns):
                return
            off = u - self._echo.device_ns((echo.sent_ns + echo.received_ns) // 2)
            self._begin(_clock_events.echo_jump_event(off))
            u = self._ticks_reader(tick_clock).echo_ns(echo.ticks)
            self._echo = EchoFit()
        self._echo.feed(u, echo.sent_ns, echo.received_ns)

    def edge_ns(self, ticks: int, tick_clock: TickClock | None) -> int | None:
        """Return the device time of a sync edge, ns; None if it cannot be converted.

        An edge may occur at any time within a tick, so half a tick is added.
        """
        if tick_clock is None or tick_clock != self._tick_clock or self._line.last_u is None:
            return None
        reader = self._ticks_reader(tick_clock)
        return reader.echo_ns(ticks) + reader.to_ns(1) // 2

    def feed_sync_edge(self, u: int, v: int, reference: HostTime) -> None:
        """Add a sync edge with device time `u` and time `v` on the clock `reference`, ns."""
        direct = self._direct
        if direct is not None and not isinstance(direct, SyncEdgeFit):
            return  # the device clock is declared to be the host clock
        if direct is None or direct.reference is not reference or direct.broken:
            if self._refused:
                return
            grain = 0.0 if self._tick_clock is None else TickTime(self._tick_clock).to_ns(1)
            self._direct = direct = SyncEdgeFit(reference, float(grain))
        direct.feed(u, v)

    def feed_sample(
        self,
        ticks: int | None,
        counter: int | None,
        arrival_ns: int,
        tick_clock: TickClock | None = None,
    ) -> Stamp:
        """Return the timestamp of a sample.

        Parameters
        ----------
        ticks, counter : int or None
            Device time and sequence number in the message of the sample.
        arrival_ns : int
            Host time of the first byte, ns.
        tick_clock : TickClock or None
            Rate and modulus of `ticks`; without it `ticks` are ignored.
        """
        reader = self._reader_for(ticks, counter, tick_clock)
        before_ns, self._arrival_ns = self._arrival_ns, arrival_ns
        if reader is None:
            return self._by_arrival(arrival_ns)

        u = reader.feed(ticks, counter, arrival_ns, self._envelope, self._echo)
        news = (
            reader.explain(ticks, counter, arrival_ns - before_ns)
            if u is None
            else self._impossible(u, arrival_ns)
        )
        if self._away_since_ns is not None and u is not None:
            news = self._restart_while_away(u, reader, arrival_ns - self._away_since_ns)
            if news is None:
                self._away_since_ns = None

        if u is None or news is not None:
            self._begin(news)
            reader = self._reader_for(ticks, counter, tick_clock)
            if reader is not None:
                u = reader.feed(ticks, counter, arrival_ns, self._envelope, self._echo)
            u = arrival_ns if reader is None or u is None else u
        elif self._doubts.early:
            return self._by_arrival(arrival_ns)

        last_u = self._line.last_u
        if last_u is None or u > last_u:
            return self._stamp(u, arrival_ns)

        # The fit uses neither a duplicate sample (u = last_u) nor a reordered sample.
        last_t = last_u if self._line.last_t is None else self._line.last_t
        sigma = inf if self.sigma_ns is None else self.sigma_ns
        return Stamp(last_t - (last_u - u), sigma, self._synced, self.epoch, u == last_u)

    # --- source of device time ---------------------------------------------------------------

    def _ticks_reader(self, tick_clock: TickClock) -> TickTime:
        reader = self._reader
        if not isinstance(reader, TickTime) or tick_clock != self._tick_clock:
            if reader is not None:
                self._begin(_clock_events.CLOCK_SOURCE_CHANGED)
            self._tick_clock, self._kind = tick_clock, _TICKS
            self._reader = reader = TickTime(tick_clock)
            self._direct = declared_offset(tick_clock, self._unix_offset_ns)
        return reader

    def _reader_for(
        self, ticks: int | None, counter: int | None, tick_clock: TickClock | None
    ) -> DeviceTime | None:
        """Return the reader of the best available device time.

        Return None if this sample lacks the device time that earlier samples contained.
        """
        if ticks is not None and tick_clock is not None:
            self._absent = 0
            if tick_clock is self._tick_clock and self._kind == _TICKS and self._reader is not None:
                return self._reader
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
            self._begin(_clock_events.CLOCK_SOURCE_CHANGED)

        self._kind, self._absent = kind, 0
        self._envelope = MinimumDelayFilter(NOMINAL_RATE)
        make = ArrivalTime if kind == _ARRIVAL else CounterTime
        self._reader = reader = make(self._period_ns)
        return reader

    # --- plausibility ------------------------------------------------------------------------

    def _restart_while_away(self, u: int, reader: DeviceTime, elapsed_ns: int) -> ClockEvent | None:
        """Return the event if the device may have restarted while its port was closed."""
        last_u, turn_ns = self._line.last_u, reader.turn_ns
        slack_ns = AWAY_SLACK_NS + _AWAY_SHARES[self._kind] * elapsed_ns
        if last_u is None or turn_ns is None or 0 < turn_ns < AWAY_TURNS * slack_ns:
            return _clock_events.UNKNOWN_AFTER_RECONNECT
        off_ns = u - last_u - elapsed_ns
        if abs(off_ns) <= slack_ns:
            return None

        # The device's own clock starts at 0. If it has counted for longer than the port was closed,
        # the device did not restart; an adapter or a buffer delayed its samples.
        uptime_ns = u % turn_ns if turn_ns else u
        own = self._tick_clock is not None and self._tick_clock.scale == "own"
        counted = self._kind == _TICKS and own and uptime_ns > elapsed_ns + slack_ns
        if counted and last_u < u and off_ns < 0:
            return None
        return _clock_events.clock_reset_event(u - last_u, elapsed_ns)

    def _impossible(self, u: int, arrival_ns: int) -> ClockEvent | None:
        """Return an event if samples are too early or permanently late relative to the fit."""
        last_u, doubts = self._line.last_u, self._doubts
        if last_u is None or u <= last_u:
            return None
        echo, envelope = self._echo, self._envelope
        if echo is not None and echo.settled:
            return doubts.feed(min(arrival_ns - echo.host_ns(u), 0), 0.0, arrival_ns)
        excess = envelope.residual(u, arrival_ns - u)
        if -STEP_NS <= excess < LATE_NS:
            if doubts.any:
                doubts.clear()
            return None
        if envelope.settled:
            return doubts.feed(excess, envelope.sigma_ns(u), arrival_ns)
        if excess < 0.0:
            # The previous samples were read from stale bytes, up to seconds after their arrival, so
            # the fit is discarded.
            self._envelope = MinimumDelayFilter(NOMINAL_RATE if self._kind != _TICKS else CRYSTAL)
        return None

    # --- timestamps --------------------------------------------------------------------------

    def _stamp(self, u: int, arrival_ns: int) -> Stamp:
        estimate = self._estimate(u, arrival_ns)
        if self._direct is not None:
            estimate = self._apply_direct_time(u, estimate, self._direct)
        target, skew, settled, sigma, delay = estimate
        jitter = self.jitter_ns
        self.jitter_ns = delay if jitter is None else jitter + _JITTER_GAIN * (delay - jitter)

        t, step = self._line.stamp(u, target, skew, slew=self._synced)
        if step:
            self.epoch += 1
            self._synced = False
            self.news.append(_clock_events.estimate_step_event(step))

        # A slewed timestamp counts as synced only once it has reached the estimate.
        self._synced = settled = settled and (self._synced or t - target < CAUGHT_UP_NS)

        self.sigma_ns = sigma = sigma + abs(t - target)
        self.minute.feed(arrival_ns, arrival_ns - t)
        self._looked += 1
        if self._looked >= _SKEW_CHECK_SAMPLES:
            self._check_skew()
        return Stamp(t, sigma, settled, self.epoch)

    def _estimate(self, u: int, arrival_ns: int) -> Estimate:
        echo, envelope = self._echo, self._envelope
        if echo is not None and echo.settled:
            target = echo.host_ns(u)
            delay, sigma = float(arrival_ns - target), echo.sigma_ns(target)
            return target, -echo.slope, True, sigma, delay

        delay = abs(envelope.feed(u, arrival_ns - u))
        offset, sigma = envelope.at(u)
        if self._kind == _ARRIVAL:
            sigma = max(sigma, _ARRIVAL_SIGMA * self._period_ns)
        settled = envelope.settled and (echo is None or not echo.expects_more(arrival_ns))
        return u + offset - self.latency_ns, envelope.skew, settled, sigma, delay

    def _apply_direct_time(self, u: int, estimate: Estimate, direct: DirectTime) -> Estimate:
        """Return the host time from `direct`, or `estimate` if the two contradict each other."""
        self._state_direct = direct.usable(u)
        if not self._state_direct:
            return estimate

        target = direct.host_ns(u)
        estimated, _, settled, sigma, delay = estimate
        if not settled and not possible(target, self._arrival_ns):
            self._state_direct = False  # only a settled estimate can prove the direct time wrong
            return estimate
        slack = MARGIN_NS + _PRIOR_SIGMAS * (sigma + self.latency_sd_ns) + (self.bound_ns or 0.0)
        if settled and abs(target - estimated) > slack:
            self.news.append(_clock_events.sync_disagreement_event(target, estimated))
            self._direct, self._refused, self._state_direct = None, True, False
            return estimate
        return target, direct.slope, True, direct.sigma_at(u), delay

    def _check_skew(self) -> None:
        """Add a warning to ``news``, once, if the skew is implausible for any clock."""
        self._looked = 0
        if self._warned or not self._synced:
            return
        echo = self._echo
        kind = "echo" if echo is not None else "ticks" if self._kind == _TICKS else "samples"
        sigma = self._envelope.skew_sigma if echo is None else echo.skew_sigma
        warning = _clock_events.skew_warning(kind, 1e6 * self.slope, 1e6 * sigma)
        if warning is not None:
            self._warned = True
            self.news.append(warning)

    def _by_arrival(self, arrival_ns: int) -> Stamp:
        """Return the timestamp of a sample without usable device time, from its arrival."""
        t = arrival_ns - self.latency_ns - round(self.jitter_ns or 0.0)
        return Stamp(self._line.forward(t), float(self._period_ns), synced=False, epoch=self.epoch)
