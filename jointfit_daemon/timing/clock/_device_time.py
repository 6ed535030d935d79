"""Device time in nanoseconds from ticks, a sample counter, or arrivals.

Each reader is used from one restart of a device to the next. ``feed`` returns the device time u of
a sample in ns. A reordered sample has a smaller device time than the sample before. If ``feed``
detects a restart of the device, it returns None; the caller then passes the sample to a new reader.
"""

from __future__ import annotations

from math import log
from typing import TYPE_CHECKING

from jointfit_daemon.timing.clock._clock_events import clock_event, clock_restart_event
from jointfit_daemon.timing.clock._counter_wrap import unwrap
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from jointfit_daemon.model import TickClock
    from jointfit_daemon.timing.clock._clock_events import ClockEvent
    from jointfit_daemon.timing.clock._echo_fit import EchoFit
    from jointfit_daemon.timing.clock._minimum_delay import MinimumDelayFilter

FALL_NS = 500_000_000
"""Decrease of device time that indicates a restart instead of a reordered sample, ns."""
BACKWARD_LIMIT = 4
"""Number of consecutive samples with decreased time that indicates a restart."""
COUNTER_WIDTHS = (1 << 8, 1 << 16, 1 << 32)
"""Moduli of sample counters."""

_GAP = 1.5
"""Least interval that is compared with the counter, in multiples of the usual interval."""
_SLACK = 3
"""Largest accepted difference between the changes of device time and counter, counts."""
_SILENCE_LEAST_NS = 500_000_000
"""Least silence over which device time is compared with host time, ns. A busy host causes shorter
delays.
"""
_SILENCE_SHARE = 0.1
"""Largest difference of device time and host time over a silence, as a fraction of the silence."""
_BACKLOG_NS = 100_000_000
"""Least delay of a backlog (samples that waited in a buffer), ns, and tolerance of the first sample
after the backlog.
"""
_WRAP_SLACK = 8
"""Largest accepted difference, counts, between the change of the counter and the elapsed time at
the first wrap. If a quarter of the elapsed time is larger, this quarter is the limit.
"""
_LATE = 0.65
"""Delay from which a sample counts as late, periods."""
_DOUBTFUL = 0.35
"""Largest distance of a delay from a whole number of periods at which lost samples explain the
delay, periods.
"""
_LATE_LEAST_NS = 50_000_000
"""Least duration of lateness before samples count as lost, ns."""
_LATE_PERIODS = 3
"""Least duration of lateness before samples count as lost, periods."""
_LATE_SHARE_GAIN = 0.02
"""Gain of the running share of late samples."""
_LATE_SHARE_FIRST = 0.2
"""Initial share of late samples."""
_LATE_SHARE_LEAST = 0.03
"""Lower bound of the share of late samples. With this share, 4 late samples in a row count as a
loss.
"""
_LATE_SHARE_MOST = 0.65
"""Upper bound of the share of late samples. With this share, 33 late samples in a row count as a
loss.
"""
_LATE_LOG_CHANCE = -14.0
"""Natural logarithm of a probability, about one in a million. If a run of late samples is less
probable than this by chance, samples count as lost.
"""
_SILENCE_NS = 2 * NS_PER_S
"""Silence after which samples without device time cannot be numbered, ns."""


def _ran_on(step_ns: int, elapsed_ns: int) -> bool:
    """Return whether device time advanced by the duration of a silence."""
    near = abs(step_ns - elapsed_ns) <= _SILENCE_SHARE * elapsed_ns
    return near and elapsed_ns >= _SILENCE_LEAST_NS


def _has_backlog_ended(
    ahead_ns: int, u: int, arrival_ns: int, envelope: MinimumDelayFilter, echo: EchoFit | None
) -> bool:
    """Return whether device time advanced more than the arrivals because a backlog has ended.

    The sample before was then late, and this sample is not. According to the settled clock, this
    sample was therefore taken before its arrival. After a jump of the device clock without a
    backlog, the settled clock would return a sampling instant after the arrival.
    """
    if ahead_ns <= _BACKLOG_NS:
        return False

    if echo is not None and echo.settled:  # the minimum-delay filter then gets no samples
        return arrival_ns - echo.host_ns(u) >= -_BACKLOG_NS
    return envelope.settled and envelope.residual(u, arrival_ns - u) >= -_BACKLOG_NS


class TickTime:
    """Reader of device timestamps, with wraps and a consistency check against a sample counter.

    If device time and counter step forward together, samples are missing and the clock continues.
    If only device time steps forward, the device restarted. There are two exceptions, in which the
    clock of the device kept running: the step equals the time without samples, or it equals the
    delay of a backlog that has ended.
    """

    __slots__ = ("_arrival_ns", "_backward", "_clock", "_counter", "_last", "_step", "_turn_ns")

    def __init__(self, clock: TickClock) -> None:
        self._clock = clock
        self._turn_ns = self.to_ns(clock.modulus) if clock.modulus else 0
        self._last: int | None = None
        self._arrival_ns = self._backward = 0
        self._counter: int | None = None
        self._step: float | None = None  # ticks per count

    @property
    def turn_ns(self) -> int | None:
        """Period after which the ticks repeat, ns; 0 if they never repeat."""
        return self._turn_ns

    def forget_counter(self) -> None:
        """Skip the next counter check, because a device counts no samples during configuration."""
        self._counter = None

    def to_ns(self, ticks: int) -> int:
        """Return unwrapped ticks in ns, in integer arithmetic."""
        rate = self._clock.ticks_per_s
        return ticks * self._clock.tick_ns if rate is None else ticks * NS_PER_S // rate

    def echo_ns(self, ticks: int) -> int:
        """Return the device time of an echo, ns, in the tick cycle nearest to the last sample."""
        last = ticks if self._last is None else self._last
        return self.to_ns(unwrap(ticks, last, self._clock.modulus, 0, self._turn_ns))

    def feed(
        self, ticks: int | None, counter: int | None, arrival_ns: int,
        envelope: MinimumDelayFilter, echo: EchoFit | None = None,
    ) -> int | None:  # fmt: skip
        """Return the device time, ns; None if the device restarted.

        The clock fits `envelope` and `echo` show whether a backlog of samples has ended.
        """
        if ticks is None:
            return None
        last = self._last
        if last is not None:
            elapsed = arrival_ns - self._arrival_ns
            ticks = unwrap(ticks, last, self._clock.modulus, elapsed, self._turn_ns)
            if ticks < last:
                self._backward += 1
                fell = self._backward >= BACKWARD_LIMIT or self.to_ns(last - ticks) > FALL_NS
                return None if fell else self.to_ns(ticks)
            step_ns, u = self.to_ns(ticks - last), self.to_ns(ticks)
            ran_on = _ran_on(step_ns, elapsed) or _has_backlog_ended(
                step_ns - elapsed, u, arrival_ns, envelope, echo
            )
            if not ran_on and self._contradicts(ticks - last, counter):
                return None
        self._last, self._arrival_ns, self._backward = ticks, arrival_ns, 0
        self._counter = counter
        return self.to_ns(ticks)

    def explain(self, ticks: int | None, counter: int | None, elapsed_ns: int) -> ClockEvent:  # noqa: ARG002 - signature of all readers
        """Return the event for a restart at this sample, `elapsed_ns` after the last sample."""
        before, modulus = self._last or 0, self._clock.modulus
        if modulus:
            before %= modulus
        return clock_restart_event(self.to_ns(before), self.to_ns(ticks or 0), elapsed_ns)

    def _contradicts(self, step: int, counter: int | None) -> bool:
        """Return whether `step` ticks and the counter change contradict each other."""
        before = self._counter
        if counter is None or before is None or step == 0:
            return False
        counts, usual = counter - before, self._step
        if counts == 1 and step == usual:
            return False  # the usual case

        if usual is not None and step > _GAP * usual:
            expected = round(step / usual)
            slack = _SLACK + expected // 100
            shared = any(
                min((counts - expected) % width, (expected - counts) % width) <= slack
                for width in COUNTER_WIDTHS
                if width > counter and width > before
            )
            if not shared:
                return True
        if 0 < counts <= _SLACK:
            self._step = step / counts
        return False


class CounterTime:
    """Reader of a sample counter; its width is determined at the first wrap."""

    __slots__ = ("_arrival_ns", "_backward", "_last", "_period_ns", "_raw", "_width")

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._width: int | None = None
        self._last: int | None = None
        self._raw = self._arrival_ns = self._backward = 0

    @property
    def turn_ns(self) -> int | None:
        """Shortest possible period of the counter, ns."""
        return self._period_ns * (self._width or min(w for w in COUNTER_WIDTHS if w > self._raw))

    def feed(
        self, ticks: int | None, counter: int | None, arrival_ns: int,  # noqa: ARG002 - signature of all readers
        envelope: MinimumDelayFilter, echo: EchoFit | None = None,  # noqa: ARG002 - signature of all readers
    ) -> int | None:  # fmt: skip
        """Return sample number times nominal period, ns, or None for a restart."""
        if counter is None:
            return None
        last, number = self._last, counter
        if last is not None:
            number = self._unwrap(counter, last, arrival_ns - self._arrival_ns)
            if number < last:
                self._backward += 1
                fell_ns = (last - number) * self._period_ns
                late = self._backward < BACKWARD_LIMIT and fell_ns <= FALL_NS
                return number * self._period_ns if late else None
        self._last, self._raw, self._arrival_ns, self._backward = number, counter, arrival_ns, 0
        return number * self._period_ns

    def explain(self, ticks: int | None, counter: int | None, elapsed_ns: int) -> ClockEvent:  # noqa: ARG002 - signature of all readers
        """Return the event for a restart at this sample, `elapsed_ns` after the last sample."""
        period = self._period_ns
        return clock_restart_event(self._raw * period, (counter or 0) * period, elapsed_ns)

    def _unwrap(self, counter: int, last: int, elapsed_ns: int) -> int:
        period = self._period_ns
        if self._width is None and counter < self._raw:
            expected = elapsed_ns / period
            for width in COUNTER_WIDTHS:
                counts = (counter - self._raw) % width
                slack = max(_WRAP_SLACK, expected / 4)
                if self._raw < width and abs(counts - expected) <= slack:
                    self._width = width
                    return last + counts
        if self._width is None or counter >= self._width:
            return last + counter - self._raw
        return unwrap(counter, last, self._width, elapsed_ns, self._width * period)


class ArrivalTime:
    """Numbering of the evenly spaced samples of a device without timestamps or counter.

    A late sample is either part of a burst or follows lost samples. Only the next samples
    distinguish the two causes: after a burst they return to the minimum-delay line, after a loss
    they do not. Numbers are therefore consecutive until more successive samples are late than the
    usual share of late samples explains. The number of lost samples is then the delay of the late
    samples in whole periods. If the delay is not a multiple of the period, numbering restarts.
    """

    __slots__ = (
        "_arrival_ns", "_late_ns", "_late_samples", "_late_share", "_least", "_number",
        "_period_ns",
    )  # fmt: skip

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._number = -1
        self._arrival_ns = self._late_ns = self._late_samples = 0
        self._least, self._late_share = 0.0, _LATE_SHARE_FIRST

    @property
    def turn_ns(self) -> int | None:
        """None, because arrivals do not contain the device's own time."""
        return None

    def feed(
        self, ticks: int | None, counter: int | None, arrival_ns: int,  # noqa: ARG002 - signature of all readers
        envelope: MinimumDelayFilter, echo: EchoFit | None = None,  # noqa: ARG002 - signature of all readers
    ) -> int | None:  # fmt: skip
        """Return sample number times nominal period, ns, or None for a restart."""
        number, period = self._number + 1, self._period_ns
        if number and arrival_ns - self._arrival_ns > _SILENCE_NS:
            return None

        u = number * period
        late = envelope.residual(u, arrival_ns - u) / period
        self._late_share += _LATE_SHARE_GAIN * ((late >= _LATE) - self._late_share)
        if late < _LATE:
            self._late_samples = 0
        elif self._late_samples == 0:
            self._late_samples, self._late_ns, self._least = 1, arrival_ns, late
        else:
            self._late_samples += 1
            self._least = min(self._least, late)
            waited = arrival_ns - self._late_ns
            share = min(max(self._late_share, _LATE_SHARE_LEAST), _LATE_SHARE_MOST)
            if waited >= max(
                _LATE_PERIODS * period, _LATE_LEAST_NS
            ) and self._late_samples >= _LATE_LOG_CHANCE / log(share):
                lost = round(self._least)
                if abs(self._least - lost) > _DOUBTFUL:
                    return None
                number += lost
                self._late_samples = 0

        self._number, self._arrival_ns = number, arrival_ns
        return number * period

    def explain(self, ticks: int | None, counter: int | None, elapsed_ns: int) -> ClockEvent:  # noqa: ARG002 - signature of all readers
        """Return the event for a restart at this sample, `elapsed_ns` after the last sample."""
        if elapsed_ns > _SILENCE_NS:
            return clock_event(
                f"no samples for {elapsed_ns / NS_PER_S:.1f} s from a device without sample "
                "counter; sample numbering restarted"
            )
        return clock_event(
            "sample delay is not a multiple of the period; sample numbering restarted"
        )


DeviceTime = TickTime | CounterTime | ArrivalTime
"""Reader of the time of one device between two restarts.

`turn_ns` is the period after which the device readings repeat, ns. It is 0 if they never repeat,
and None if the device sends no readings.
"""
