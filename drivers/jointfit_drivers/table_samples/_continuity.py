"""Time and counter of a device that a table describes: losses, restarts, and corrupt values.

In the table, d is the step of device time, c is the step of the counter (modulo the number of its
values), and P is the measured sample period:

| finding                                                  | outcome                          |
|----------------------------------------------------------|----------------------------------|
| c and n = round(d / P) differ by at most 2 + n / 100     | same clock; c - 1 samples lost   |
| no counter; d is not negative, and is at most 100 P or   | same clock; round(d / P) - 1     |
| about equal to the step of the arrival times             | samples lost                     |
| no time; c is not negative, and fits the arrival times   | c - 1 samples lost               |
| none of the above                                        | the sample is held for the next  |
| the next sample continues the held one                   | the device restarted             |
| the next sample continues the last accepted one          | the held one was corrupt         |

Invariant: the result depends only on the values fed. The module reads no clock, and accepts every
input.
"""

from __future__ import annotations

from statistics import median
from typing import NamedTuple

_LEARNED = 10
"""Number of steps after which the measured period is used."""
_SLACK_COUNTS = 2
_SLACK_SHARE = 0.01
_SHORT = 100
"""Longest gap that the arrivals need not confirm, samples."""
_LATE_NS = 500_000_000
"""Largest difference between device time and arrival time over a gap, ns."""
_LATE_SHARE = 0.02
_AMBIGUOUS = 0.05
"""Largest tolerance with which the counter can confirm a step, as a share of the number of the
counter's values."""
_FASTER = 4.0
"""Largest factor by which buffered messages may arrive faster than their rate."""


class RecordStep(NamedTuple):
    """Classification of one sample. A *held* sample waits for the next sample to confirm it."""

    lost: int = 0
    """Number of samples lost before this sample; 0 if the held sample is confirmed."""
    restarted: bool = False
    """Whether the device restarted before the held sample."""
    held: bool = False
    """Whether this sample must wait for the next sample."""
    confirmed: bool = False
    """Whether the held sample is valid and must be used before this sample. A held sample that is
    not confirmed is dropped."""
    lost_since: int = 0
    """Number of samples lost between the held sample and this sample."""


class _Point(NamedTuple):
    ticks: int | None
    counter: int | None
    arrival_ns: int


_CONTINUES = RecordStep()
_HELD = RecordStep(held=True)


class RecordContinuity:
    """Checks time and counter of one device.

    Parameters
    ----------
    rate_hz : float
        Nominal rate, Hz.
    tick_ns : float
        Duration of a tick of device time, ns.
    modulus, counts : int, optional
        Number of values of device time and of the counter; None if the value never wraps.
    """

    def __init__(
        self, rate_hz: float, tick_ns: float, modulus: int | None, counts: int | None
    ) -> None:
        self._period_ns = 1e9 / rate_hz
        self._tick_ns, self._modulus, self._counts = tick_ns, modulus, counts
        self._steps: list[float] = []
        self._period: float | None = None  # ticks
        self._last: _Point | None = None
        self._held: _Point | None = None

    def take(self, ticks: int | None, counter: int | None, arrival_ns: int) -> RecordStep:
        """Return the classification of the next sample."""
        point = _Point(ticks, counter, arrival_ns)
        last, held = self._last, self._held
        if last is None:
            self._last = point
            return _CONTINUES

        samples = self._samples(last, point)
        if samples is not None:
            self._last, self._held = point, None
            return _CONTINUES if samples <= 1 else RecordStep(samples - 1)

        since = None if held is None else self._samples(held, point)
        if held is None or since is None:
            self._held = point
            return _HELD

        self._last, self._held = point, None
        self._steps, self._period = [], None
        return RecordStep(restarted=True, confirmed=True, lost_since=max(since - 1, 0))

    def _samples(self, last: _Point, point: _Point) -> int | None:
        """Return the number of samples from `last` to `point`; None if `point` does not follow."""
        c = self._count(last, point)
        if last.ticks is None or point.ticks is None:
            return self._count_by_counter(c, point.arrival_ns - last.arrival_ns)

        d = point.ticks - last.ticks
        if self._modulus is not None:
            d = (d + self._modulus // 2) % self._modulus - self._modulus // 2
        if d < 0:
            return None
        if self._period is None:
            return self._learn(d, c)

        expected = round(d / self._period)
        slack = _SLACK_COUNTS + _SLACK_SHARE * expected
        is_ambiguous = c is None or (self._counts is not None and slack > _AMBIGUOUS * self._counts)
        if expected > _SHORT and is_ambiguous:
            elapsed_ns, passed_ns = point.arrival_ns - last.arrival_ns, d * self._tick_ns
            if abs(passed_ns - elapsed_ns) > _LATE_NS + _LATE_SHARE * abs(elapsed_ns):
                return None
        if c is None:
            return expected
        if self._counts is not None:
            c += self._counts * max(0, round((expected - c) / self._counts))
        return c if abs(c - expected) <= slack else None

    def _learn(self, d: int, c: int | None) -> int | None:
        """Return the number of samples in one of the first steps; None if the step is too long.

        The step contributes to the measured period.
        """
        most = _SHORT * self._period_ns / self._tick_ns
        if d > most or (c is not None and c > _SHORT):
            return None
        if d > 0:
            self._steps.append(d / max(c or 1, 1))
        if len(self._steps) >= _LEARNED:
            self._period = median(self._steps)
        return 1 if c is None else c

    def _count(self, last: _Point, point: _Point) -> int | None:
        """Return the step of the counter; None if one of the samples has no counter."""
        if last.counter is None or point.counter is None:
            return None
        step = point.counter - last.counter
        return step if self._counts is None else step % self._counts

    def _count_by_counter(self, c: int | None, elapsed_ns: int) -> int | None:
        """Return the number of samples since the last one, according to the counter.

        Return 1 without a counter, and None if the step `c` contradicts the arrival times.
        """
        if c is None:
            return 1
        samples = elapsed_ns / self._period_ns
        if self._counts is not None and c < self._counts // 2:
            return c + self._counts * max(0, round((samples - c) / self._counts))
        return c if 0 <= c <= _SHORT + _FASTER * samples else None
