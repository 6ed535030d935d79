"""What a device says of time, as nanoseconds that only grow: from ticks, a counter, or nothing.

Law: pure; one reader lives from one restart of a device to the next. ``feed`` returns the device
time u of a sample in ns, smaller than before if the sample was reordered, and None when the device
must have restarted: then this reader is of no more use and a fresh one reads the sample again.
"""

from __future__ import annotations

from math import log
from typing import TYPE_CHECKING, Protocol

from jointfit_daemon.timing.clock._clock_events import began_anew, said
from jointfit_daemon.timing.clock._counter_wrap import unwrap

if TYPE_CHECKING:
    from jointfit_daemon.model import TickClock
    from jointfit_daemon.timing.clock._clock_events import ClockNews
    from jointfit_daemon.timing.clock._minimum_delay import Envelope

NS = 1_000_000_000
FALL_NS = 500_000_000
"""Device time that falls by more is a restart, not a reordered sample."""
BACKWARD_LIMIT = 4
"""Samples in a row from the past that are a restart, however small the fall."""
COUNTER_WIDTHS = (1 << 8, 1 << 16, 1 << 32)

_GAP = 1.5
_SLACK = 3
_WRAP_SLACK = 8
_LATE = 0.65
_DOUBTFUL = 0.35
_LATE_LEAST_NS = 50_000_000
_LATE_PERIODS = 3
_LATE_SHARE_GAIN = 0.02
_LATE_SHARE_FIRST = 0.2
_LATE_SHARE_LEAST, _LATE_SHARE_MOST = 0.03, 0.65  # 4 to 32 late samples in a row decide
_LATE_LOG_CHANCE = -14.0  # one in a million
_SILENCE_NS = 2 * NS


class DeviceTime(Protocol):
    """Reads the time of one device between two restarts."""

    @property
    def turn_ns(self) -> int | None:
        """Time after which the readings repeat, ns: 0 if they never do, None if they are none."""

    def feed(
        self, ticks: int | None, counter: int | None, arrival_ns: int, envelope: Envelope
    ) -> int | None:
        """Return device time in ns, or None for a restart."""

    def explain(self, ticks: int | None, counter: int | None, elapsed_ns: int) -> ClockNews:
        """Say why this sample, `elapsed_ns` after the one before, was a restart."""


class TickTime:
    """Reads time stamps: wraps, and a counter beside them that must not contradict them.

    A step forward together with the counter is a gap in the same clock; a step that the counter
    does not share is a restart.
    """

    __slots__ = ("_arrival_ns", "_backward", "_clock", "_counter", "_last", "_step", "_turn_ns")

    def __init__(self, clock: TickClock) -> None:
        self._clock = clock
        self._turn_ns = self.to_ns(clock.modulus) if clock.modulus else 0
        self._last: int | None = None
        self._arrival_ns = self._backward = 0
        self._counter: int | None = None
        self._step: float | None = None  # ticks a count

    @property
    def turn_ns(self) -> int | None:
        """Time after which the ticks start again, ns; 0 if they never do."""
        return self._turn_ns

    def forget_counter(self) -> None:
        """Compare the next sample by time alone: a device that is configured counts no samples."""
        self._counter = None

    def to_ns(self, ticks: int) -> int:
        """Return unwrapped ticks in ns, by integers only."""
        rate = self._clock.ticks_per_s
        return ticks * self._clock.tick_ns if rate is None else ticks * NS // rate

    def echo_ns(self, ticks: int) -> int:
        """Return the time of an echo, ns, on the turn nearest to the last sample."""
        last = ticks if self._last is None else self._last
        return self.to_ns(unwrap(ticks, last, self._clock.modulus, 0, self._turn_ns))

    def feed(
        self, ticks: int | None, counter: int | None, arrival_ns: int, envelope: Envelope  # noqa: ARG002 - the readers' common shape
    ) -> int | None:  # fmt: skip
        """Return device time in ns, or None for a restart."""
        if ticks is None:
            return None
        last = self._last
        if last is not None:
            elapsed = arrival_ns - self._arrival_ns
            ticks = unwrap(ticks, last, self._clock.modulus, elapsed, self._turn_ns)
            if ticks < last:
                return self._past(ticks, last)
            if self._contradicted(ticks - last, counter):
                return None
        self._last, self._arrival_ns, self._backward = ticks, arrival_ns, 0
        self._counter = counter
        return self.to_ns(ticks)

    def explain(self, ticks: int | None, counter: int | None, elapsed_ns: int) -> ClockNews:  # noqa: ARG002 - the readers' common shape
        """Say why this sample, `elapsed_ns` after the one before, was a restart."""
        before, modulus = self._last or 0, self._clock.modulus
        if modulus:
            before %= modulus
        return began_anew(self.to_ns(before), self.to_ns(ticks or 0), elapsed_ns)

    def _past(self, ticks: int, last: int) -> int | None:
        self._backward += 1
        if self._backward >= BACKWARD_LIMIT or self.to_ns(last - ticks) > FALL_NS:
            return None
        return self.to_ns(ticks)

    def _contradicted(self, step: int, counter: int | None) -> bool:
        """Tell whether `step` ticks and the counts passed meanwhile cannot both be true."""
        before = self._counter
        if counter is None or before is None or step == 0:
            return False
        counts, usual = counter - before, self._step
        if counts == 1 and step == usual:
            return False  # as nearly always
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
    """Numbers samples by the device's own counter; its width is learned when it first wraps."""

    __slots__ = ("_arrival_ns", "_backward", "_last", "_period_ns", "_raw", "_width")

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._width: int | None = None
        self._last: int | None = None
        self._raw = self._arrival_ns = self._backward = 0

    @property
    def turn_ns(self) -> int | None:
        """Time after which the counter starts again, ns, the shortest that is possible."""
        return self._period_ns * (self._width or min(w for w in COUNTER_WIDTHS if w > self._raw))

    def feed(
        self, ticks: int | None, counter: int | None, arrival_ns: int, envelope: Envelope  # noqa: ARG002 - the readers' common shape
    ) -> int | None:  # fmt: skip
        """Return the number of the sample times the nominal period, or None for a restart."""
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

    def explain(self, ticks: int | None, counter: int | None, elapsed_ns: int) -> ClockNews:  # noqa: ARG002 - the readers' common shape
        """Say why this sample, `elapsed_ns` after the one before, was a restart."""
        period = self._period_ns
        return began_anew(self._raw * period, (counter or 0) * period, elapsed_ns)

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
    """Numbers the samples of a device that says nothing: they are evenly spaced.

    A late sample may be one of a bunch, or others before it may be lost, and only the next ones
    can tell: a bunch catches up with the envelope, a loss does not. So numbers are consecutive
    until samples have stayed late for longer than the usual share of late ones explains; then the
    whole periods they are late were losses. A rest that is no whole period is a doubt, and the
    numbering begins anew.
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
        """Return None: arrivals show nothing of the device's own time."""
        return None

    def feed(
        self, ticks: int | None, counter: int | None, arrival_ns: int, envelope: Envelope  # noqa: ARG002 - the readers' common shape
    ) -> int | None:  # fmt: skip
        """Return the number of the sample times the nominal period, or None for a restart."""
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
            if self._decided(arrival_ns):
                lost = round(self._least)
                if abs(self._least - lost) > _DOUBTFUL:
                    return None
                number += lost
                self._late_samples = 0
        self._number, self._arrival_ns = number, arrival_ns
        return number * period

    def explain(self, ticks: int | None, counter: int | None, elapsed_ns: int) -> ClockNews:  # noqa: ARG002 - the readers' common shape
        """Say why this sample, `elapsed_ns` after the one before, was a restart."""
        if elapsed_ns > _SILENCE_NS:
            return said(f"nothing for {elapsed_ns / NS:.1f} s, and it does not number its samples")
        return said("its samples are late by no whole number of periods: numbered anew")

    def _decided(self, arrival_ns: int) -> bool:
        waited = arrival_ns - self._late_ns
        if waited < max(_LATE_PERIODS * self._period_ns, _LATE_LEAST_NS):
            return False
        share = min(max(self._late_share, _LATE_SHARE_LEAST), _LATE_SHARE_MOST)
        return self._late_samples >= _LATE_LOG_CHANCE / log(share)
