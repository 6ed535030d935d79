"""Time and counter of a device described by a table: losses, restarts, and corrupt values.

With d the step of device time, c the step of the counter (modulo its width) and P the measured
period of a sample:

| finding                                                  | outcome                          |
|----------------------------------------------------------|----------------------------------|
| c = round(d / P) within 1 % and two counts               | same clock; c - 1 samples lost   |
| no counter, d forward, and short or as long as the gap   | same clock; round(d / P) - 1     |
| of the arrivals                                          | samples lost                     |
| no time, c forward                                       | c - 1 samples lost               |
| otherwise                                                | the sample is held               |
| the next one continues the held one                      | the device restarted             |
| the next one continues the last accepted one             | the held one was corrupt         |

Invariant: a function of the values fed, without a clock of its own; every input is accepted.
"""

from __future__ import annotations

from statistics import median
from typing import NamedTuple

_LEARNED = 10
"""Steps after which the measured period is used."""
_SLACK_COUNTS = 2
_SLACK_SHARE = 0.01
_SHORT = 100
"""Longest gap, samples, that needs no confirmation by the arrivals."""
_LATE_NS = 500_000_000
"""Largest difference between the steps of device time and of the arrivals over a gap, ns."""
_LATE_SHARE = 0.02
_AMBIGUOUS = 0.05
"""A count confirms nothing if its tolerance exceeds this share of the counter's values."""
_FASTER = 4.0
"""Factor by which messages that waited may arrive faster than their rate."""


class RecordStep(NamedTuple):
    """Classification of one sample."""

    lost: int = 0
    """Samples lost before it, or before the held one if that is confirmed."""
    restarted: bool = False
    """Whether the device restarted before the held sample."""
    held: bool = False
    """Whether this sample waits for the next sample."""
    confirmed: bool = False
    """Whether the held sample is valid and comes first; otherwise it is dropped."""
    lost_since: int = 0
    """Samples lost between the held one and this one."""


class _Point(NamedTuple):
    ticks: int | None
    counter: int | None
    arrival_ns: int


_CONTINUES = RecordStep()
_HELD = RecordStep(held=True)


class RecordContinuity:
    """Tracks time and counter of one device.

    Parameters
    ----------
    rate_hz : float
        Nominal rate, Hz.
    tick_ns : float
        Duration of a tick of device time, ns.
    modulus, counts : int, optional
        Number of values of device time and of the counter; None: it never wraps.
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
        """Return the step for the next sample."""
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
        """Return the number of samples from `last` to `point`; None if they do not follow."""
        c = self._count(last, point)
        if last.ticks is None or point.ticks is None:
            return self._counted(c, point.arrival_ns - last.arrival_ns)

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
        """Return the number of samples in one of the first steps, and measure the period."""
        most = _SHORT * self._period_ns / self._tick_ns
        if d > most or (c is not None and c > _SHORT):
            return None
        if d > 0:
            self._steps.append(d / max(c or 1, 1))
        if len(self._steps) >= _LEARNED:
            self._period = median(self._steps)
        return 1 if c is None else c

    def _count(self, last: _Point, point: _Point) -> int | None:
        """Return the step of the counter; None if one of the samples has none."""
        if last.counter is None or point.counter is None:
            return None
        step = point.counter - last.counter
        return step if self._counts is None else step % self._counts

    def _counted(self, c: int | None, elapsed_ns: int) -> int | None:
        """Return the number of samples by the counter alone."""
        if c is None:
            return 1
        samples = elapsed_ns / self._period_ns
        if self._counts is not None and c < self._counts // 2:
            return c + self._counts * max(0, round((samples - c) / self._counts))
        return c if 0 <= c <= _SHORT + _FASTER * samples else None
