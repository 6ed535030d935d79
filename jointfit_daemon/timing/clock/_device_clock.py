"""Device time to host time, one clock a device, one stamp a sample.

Law: pure and streaming. Inputs are what a decoder yields, in order of arrival; nothing here reads a
clock. A few microseconds a sample, no memory that grows.

The model is ``t(u) = u + c + s (u - u_0)``, u the device time in ns. The best way on offer rules:
edges of a sync line or a clock declared to be the host's (``direct``), else answered echoes
(``echo_clock``), which leave half the asymmetry of the path in c, else the line under the fastest
arrivals (``envelope``), which leaves the smallest delay D_min in c: what is known of it beforehand
(`latency_ns`) is taken out, the rest is found as lag from motion (``lag``).

Stamps never run backwards and are slewed (``stamps``); an error too big for that begins a new
epoch. A new epoch says: do not join what is before with what is after.
"""

from __future__ import annotations

from collections import deque
from math import inf
from typing import TYPE_CHECKING

from jointfit_daemon.timing.clock import _clock_events
from jointfit_daemon.timing.clock._delay_statistics import LastMinute
from jointfit_daemon.timing.clock._device_time import ArrivalTime, CounterTime, TickTime
from jointfit_daemon.timing.clock._direct_time import MARGIN_NS, PulseTie, declared, possible
from jointfit_daemon.timing.clock._echo_fit import STALE_NS, EchoFit
from jointfit_daemon.timing.clock._minimum_delay import CRYSTAL, NOMINAL_RATE, Envelope
from jointfit_daemon.timing.clock._plausibility import LATE_NS, Plausibility
from jointfit_daemon.timing.clock._stamps import STEP_NS, Stamp, StampLine

if TYPE_CHECKING:
    from jointfit_daemon.model import ClockEcho, TickClock
    from jointfit_daemon.timing.clock._clock_events import ClockNews
    from jointfit_daemon.timing.clock._device_time import DeviceTime
    from jointfit_daemon.timing.clock._direct_time import Direct, HostTime
    from jointfit_daemon.timing.clock._stamps import Estimate

ABSENT_LIMIT = 100
"""Samples in a row without the time they used to carry, before the clock does without it."""
CAUGHT_UP_NS = 50_000
AWAY_SLACK_NS = 500_000_000
"""How far device time may be off after the port was closed, ns: bytes may have waited somewhere."""
AWAY_TURNS = 20
"""A reading repeats after so many slacks at the least, else a restarted device may seem to agree:
by chance in one of ten cases."""

_ARRIVAL, _COUNTER, _TICKS = range(3)
_JITTER_GAIN = 0.01
_ARRIVAL_SIGMA = 0.1
_PRIOR_SIGMAS = 4.0
_AWAY_SHARES = 0.0, 0.02, 0.001  # by kind: what nominal rate and crystal may be off
_LOOK_EVERY = 256  # samples between two looks at the skew


class DeviceClock:
    """Clock of one device, by the best on offer: sync edges, echoes, ticks, a counter, or nothing.

    Parameters
    ----------
    period_ns : int
        Nominal time between two samples, ns.
    latency_ns, latency_sd_ns : int
        What is known beforehand of the smallest delay from sampled instant to arrival: mean, which
        is subtracted where arrivals rule, and standard deviation, ns.
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
        """Sigma of the last stamp, ns; None before any."""
        self.jitter_ns: float | None = None
        """Mean delay beyond the fastest sample (else beyond the sampled instant), ns."""
        self.latency_ns, self.latency_sd_ns = latency_ns, latency_sd_ns
        self.minute = LastMinute()
        """Delays from sampled instant to arrival, and the rate."""
        self.news: deque[ClockNews] = deque(maxlen=16)
        """What is to be published; whoever does takes it out."""
        self._unix_offset_ns: int | None = None
        self._period_ns, self._line = period_ns, StampLine(period_ns)
        self._arrival_ns = 0
        self._tick_clock: TickClock | None = None
        self._kind, self._absent, self._looked, self._warned = _ARRIVAL, 0, 0, False
        self._forget()

    def _forget(self) -> None:
        """Begin to settle anew. The last stamp stays, for time never runs backwards."""
        self._reader: DeviceTime | None = None
        self._envelope = Envelope(CRYSTAL)
        self._echo: EchoFit | None = None
        self._direct: Direct | None = None
        self._refused = self._state_direct = self._synced = False
        self._away_since_ns: int | None = None
        """Last arrival before the port was closed, ns, until a sample shows what happened."""
        self._line.last_u = None
        self._doubts = Plausibility()

    # --- what is known -----------------------------------------------------------------------

    @property
    def state(self) -> str:
        """How time is told.

        ``settling``, ``direct``, ``echo``, ``passive``, ``arrival`` (no device time) or ``stale``
        (echoes stopped).
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
        """Return s in 1e-6, positive when the device clock runs slow; None while settling."""
        if not self._synced:
            return None
        direct = self._direct if self._state_direct else None
        return 1e6 * (self.slope if direct is None else direct.slope)

    @property
    def slope(self) -> float:
        """Return s by echoes or arrivals."""
        return self._envelope.skew if self._echo is None else -self._echo.slope

    @property
    def offset_ns(self) -> int | None:
        """Return host minus device time at the last sample, ns; None before any."""
        return self._line.offset_ns

    @property
    def bound_ns(self) -> float | None:
        """Return the hard limit of the unseen constant, ns; None where nothing limits it."""
        return None if self._echo is None else self._echo.bound_ns

    @property
    def last_u(self) -> int | None:
        """Return the device time of the last sample in order, ns; None before any."""
        return self._line.last_u

    @property
    def settled(self) -> bool:
        """Whether ``host_ns`` means anything yet."""
        return self._synced

    def host_ns(self, u: int) -> int:
        """Return the host time of device time `u` by echoes or arrivals, ns; not slewed."""
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

    # --- what comes in -----------------------------------------------------------------------

    def feed_restart(self) -> None:
        """Take it that the device's clock began anew, or may have."""
        self._begin(None)

    def feed_reopened(self) -> None:
        """Take it that the port was closed: the next sample shows whether the device ran on."""
        self._away_since_ns = self._arrival_ns
        if isinstance(self._reader, TickTime):
            self._reader.forget_counter()

    def _begin(self, news: ClockNews | None) -> None:
        away = self._away_since_ns is not None
        if away and news is not None and news.kind != "restart":
            news = _clock_events.after_reopening(news)
        if away or self._line.last_u is not None or self._echo is not None:
            self.epoch += 1
            if news is not None and (self._synced or news is not _clock_events.ANOTHER_WAY):
                self.news.append(news)
        self._forget()

    def feed_unix_offset(self, offset_ns: int) -> None:
        """Take UNIX time minus CLOCK_MONOTONIC, ns: clocks declared to show UNIX time need it."""
        if offset_ns != self._unix_offset_ns:
            self._unix_offset_ns = offset_ns
            if self._tick_clock is not None and self._tick_clock.scale == "unix":
                self._refused = False
                self._direct = declared(self._tick_clock, offset_ns)

    def feed_echo(self, echo: ClockEcho, tick_clock: TickClock | None = None) -> None:
        """Take an answered echo. Ignored while nobody knows how the device counts."""
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
            self._begin(_clock_events.off_echoes(off))
            u = self._ticks_reader(tick_clock).echo_ns(echo.ticks)
            self._echo = EchoFit()
        self._echo.feed(u, echo.sent_ns, echo.received_ns)

    def edge_ns(self, ticks: int, tick_clock: TickClock | None) -> int | None:
        """Return the device time of a sync edge, ns; None while there is nothing to tell it by.

        An edge falls anywhere in a tick, so on average it is half a tick after the count.
        """
        if tick_clock is None or tick_clock != self._tick_clock or self._line.last_u is None:
            return None
        reader = self._ticks_reader(tick_clock)
        return reader.echo_ns(ticks) + reader.to_ns(1) // 2

    def feed_tie(self, u: int, v: int, reference: HostTime) -> None:
        """Take it that device time `u` is the instant the `reference` calls `v`, ns."""
        direct = self._direct
        if direct is not None and not isinstance(direct, PulseTie):
            return  # declared to be the host's own
        if direct is None or direct.reference is not reference or direct.broken:
            if self._refused:
                return
            grain = 0.0 if self._tick_clock is None else TickTime(self._tick_clock).to_ns(1)
            self._direct = direct = PulseTie(reference, float(grain))
        direct.feed(u, v)

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
        before_ns, self._arrival_ns = self._arrival_ns, arrival_ns
        if reader is None:
            return self._by_arrival(arrival_ns)
        u = reader.feed(ticks, counter, arrival_ns, self._envelope)
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
            u = self._afresh(ticks, counter, arrival_ns, tick_clock)
        elif self._doubts.early:
            return self._by_arrival(arrival_ns)
        last_u = self._line.last_u
        if last_u is not None and u <= last_u:
            return self._past(u, last_u)
        return self._stamp(u, arrival_ns)

    # --- which time --------------------------------------------------------------------------

    def _ticks_reader(self, tick_clock: TickClock) -> TickTime:
        reader = self._reader
        if not isinstance(reader, TickTime) or tick_clock != self._tick_clock:
            if reader is not None:
                self._begin(_clock_events.ANOTHER_WAY)
            self._tick_clock, self._kind = tick_clock, _TICKS
            self._reader = reader = TickTime(tick_clock)
            self._direct = declared(tick_clock, self._unix_offset_ns)
        return reader

    def _reader_for(
        self, ticks: int | None, counter: int | None, tick_clock: TickClock | None
    ) -> DeviceTime | None:
        """Return the reader of the best time on offer; None for a sample without the usual one."""
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
            self._begin(_clock_events.ANOTHER_WAY)
        self._kind, self._absent = kind, 0
        self._envelope = Envelope(NOMINAL_RATE)
        make = ArrivalTime if kind == _ARRIVAL else CounterTime
        self._reader = reader = make(self._period_ns)
        return reader

    def _afresh(
        self, ticks: int | None, counter: int | None, arrival_ns: int, tick_clock: TickClock | None
    ) -> int:
        reader = self._reader_for(ticks, counter, tick_clock)
        u = None if reader is None else reader.feed(ticks, counter, arrival_ns, self._envelope)
        return arrival_ns if u is None else u

    # --- what does not fit -------------------------------------------------------------------

    def _restart_while_away(self, u: int, reader: DeviceTime, elapsed_ns: int) -> ClockNews | None:
        """Explain why the device may have restarted while its port was closed; None: it ran on."""
        last_u, turn_ns = self._line.last_u, reader.turn_ns
        slack_ns = AWAY_SLACK_NS + _AWAY_SHARES[self._kind] * elapsed_ns
        if last_u is None or turn_ns is None or 0 < turn_ns < AWAY_TURNS * slack_ns:
            return _clock_events.UNKNOWN_WHILE_AWAY
        if abs(u - last_u - elapsed_ns) > slack_ns:
            return _clock_events.did_not_run_on(u - last_u, elapsed_ns)
        return None

    def _impossible(self, u: int, arrival_ns: int) -> ClockNews | None:
        """Say what contradicts the fit: samples that came before their time, or that stay late."""
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
            # What came before was merely late, by seconds perhaps (stale bytes): no use for a fit.
            self._envelope = Envelope(NOMINAL_RATE if self._kind != _TICKS else CRYSTAL)
        return None

    # --- stamps ------------------------------------------------------------------------------

    def _stamp(self, u: int, arrival_ns: int) -> Stamp:
        estimate = self._estimate(u, arrival_ns)
        if self._direct is not None:
            estimate = self._directed(u, estimate, self._direct)
        target, skew, settled, sigma, delay = estimate
        jitter = self.jitter_ns
        self.jitter_ns = delay if jitter is None else jitter + _JITTER_GAIN * (delay - jitter)
        t, step = self._line.stamp(u, target, skew, slew=self._synced)
        if step:
            self.epoch += 1
            self._synced = False
            self.news.append(_clock_events.moved(step))
        # a stamp held back by those before it has yet to catch up with what is known by now
        self._synced = settled = settled and (self._synced or t - target < CAUGHT_UP_NS)
        self.sigma_ns = sigma = sigma + abs(t - target)
        self.minute.feed(arrival_ns, arrival_ns - t)
        self._looked += 1
        if self._looked >= _LOOK_EVERY:
            self._look()
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

    def _directed(self, u: int, estimate: Estimate, direct: Direct) -> Estimate:
        """Return what `direct` says, unless `estimate` contradicts it."""
        self._state_direct = direct.usable(u)
        if not self._state_direct:
            return estimate
        target = direct.host_ns(u)
        estimated, _, settled, sigma, delay = estimate
        if not settled and not possible(target, self._arrival_ns):
            self._state_direct = False  # no more than a suspicion, until the estimate can tell
            return estimate
        slack = MARGIN_NS + _PRIOR_SIGMAS * (sigma + self.latency_sd_ns) + (self.bound_ns or 0.0)
        if settled and abs(target - estimated) > slack:
            self.news.append(_clock_events.contradicted(target, estimated))
            self._direct, self._refused, self._state_direct = None, True, False
            return estimate
        return target, direct.slope, True, direct.sigma_at(u), delay

    def _look(self) -> None:
        """Tell once of a skew that no clock has."""
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

    def _past(self, u: int, last_u: int) -> Stamp:
        """Stamp a duplicate (u = last) or reordered sample; it teaches nothing."""
        last_t = last_u if self._line.last_t is None else self._line.last_t
        sigma = inf if self.sigma_ns is None else self.sigma_ns
        return Stamp(last_t - (last_u - u), sigma, self._synced, self.epoch, u == last_u)

    def _by_arrival(self, arrival_ns: int) -> Stamp:
        """Stamp a sample that lacks the time its neighbours have."""
        t = arrival_ns - self.latency_ns - round(self.jitter_ns or 0.0)
        return Stamp(self._line.forward(t), float(self._period_ns), synced=False, epoch=self.epoch)
