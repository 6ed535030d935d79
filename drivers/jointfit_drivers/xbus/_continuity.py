"""Counter and clock of an Xbus device: lost messages, restarts, and messages damaged unseen.

Invariant: integers in, steps out; any input is accepted. An orientation *follows* another if
counter and device time moved together, or if what is known moved by a few periods only. Every
MTData2 takes a counter value. Only those with an orientation are compared, for others may carry
foreign time (GNSS).

| orientation                                        | outcome                                    |
|----------------------------------------------------|--------------------------------------------|
| follows the last accepted one                      | accepted; what the counter passed is lost  |
| does not follow                                    | held until the next one                    |
| the next one follows the last accepted one         | the held one was damaged and is dropped    |
| the next one follows the held one                  | both accepted; a restart if time leapt,    |
|                                                    | against the counter and the arrivals; a    |
|                                                    | counter jump if time went on by one period |
| the next one follows neither                       | the held one is dropped, the next one held |

An eight-bit checksum passes one damaged message in 256, so a single message proves neither a loss
nor a restart. Agreement is within 2 % and a few counts of the stream's own rate, modulo the width
of the counter. The nominal rate is used for the first samples only.
"""

from __future__ import annotations

from typing import NamedTuple

from jointfit_protocols.xbus.configuration import TICK_NS, WRAP_32_BIT, WRAP_DAY

_COUNTS = 1 << 16
_GAP = 1.5
_PLAUSIBLE_GAP = 3600 * 1_000_000_000 // TICK_NS  # an hour: no stall or stale buffer is older
_SLACK_COUNTS = 4
_SLACK_SHARE = 0.02
_LEARNED = 10  # counts after which the stream knows its own rate
_PACE_NS = 250_000_000  # between time passed and arrivals: no bunch of samples is later
_DISTINCT = 50_000  # counts: over more the slack and the width of the counter let any pair agree


class Step(NamedTuple):
    """What one orientation means for the stream."""

    lost: int = 0
    """Messages lost before it, or before the held one that it confirms."""
    restarted: bool = False
    """The device restarted before the held one."""
    held: bool = False
    """Hold this one until the next."""
    confirmed: bool = False
    """The held one is good and comes first; else a held one is dropped."""
    lost_since: int = 0
    """Messages lost between a confirmed one and this one."""
    counter_jumped: bool = False
    """The counter alone jumped before the held one: nothing was lost."""


class _Point(NamedTuple):
    """An orientation: counter, time, arrival, and the number of messages that had come by then."""

    counter: int | None
    ticks: int | None
    arrival_ns: int
    messages: int


_GOES_ON = Step()
_HELD = Step(held=True)


class Continuity:
    """Follows one device.

    Parameters
    ----------
    rate_hz
        Nominal rate, used until the stream has shown its own.
    """

    def __init__(self, rate_hz: float) -> None:
        self.modulus: int | None = None
        """Ticks after which time starts again; None until the model or a wrap shows it."""
        self._nominal = 1_000_000_000 / TICK_NS / rate_hz
        self._messages = 0
        self._last: _Point | None = None
        self._held: _Point | None = None
        self._trusted = False  # whether anything followed the last one
        self._sum_ticks = self._sum_counts = 0

    def other(self) -> None:
        """Count an MTData2 without orientation: it takes a value of the counter."""
        self._messages += 1

    def orientation(self, counter: int | None, ticks: int | None, arrival_ns: int) -> Step:
        """Take counter, time (ticks of 100 us) and arrival of a message with an orientation."""
        self._messages += 1
        point = _Point(counter, ticks, arrival_ns, self._messages)
        last, held = self._last, self._held
        if last is None:
            self._last = point
            return _GOES_ON
        if self._follows(last, point):
            self._held = None
            return self._accept(last, point)
        if held is None or not self._follows(held, point):
            self._held = point
            return _HELD
        return self._confirm(last, held, point)

    def forget(self) -> None:
        """Begin anew: the device reported that it restarted."""
        self._last = self._held = None
        self._trusted = False
        self._sum_ticks = self._sum_counts = 0

    def _accept(self, last: _Point, point: _Point) -> Step:
        """Make `point` the last one and learn the rate from the step to it."""
        self._last, self._trusted = point, True
        counts, ticks = _counts(last, point), self._ticks(last, point)
        if counts and ticks and counts <= _DISTINCT:  # time that stands still shows no rate
            self._sum_ticks += ticks
            self._sum_counts += counts
        lost = _lost(last, point)
        return Step(lost) if lost else _GOES_ON

    def _confirm(self, last: _Point, held: _Point, point: _Point) -> Step:
        """Accept `held` and `point`, which belong together and not to `last`."""
        trusted, self._held = self._trusted, None
        step = self._classify(last, held) if trusted else _GOES_ON
        if step.restarted or not trusted:
            self._sum_ticks = self._sum_counts = 0
        since = self._accept(held, point).lost
        return step._replace(confirmed=True, lost_since=since)

    def _classify(self, last: _Point, held: _Point) -> Step:
        """Return what happened between two that do not follow."""
        ticks, counts = self._ticks(last, held), _counts(last, held)
        if ticks is None:  # the counter alone: it may fall only by a restart
            fell = counts is not None and counts > _DISTINCT
            return Step(restarted=True) if fell else Step(_lost(last, held))
        plausible = 0 <= ticks <= _PLAUSIBLE_GAP
        if counts is not None and plausible and self._agree(ticks, counts):
            turns = round((ticks / self._period - counts) / _COUNTS)
            return Step(_lost(last, held) + max(turns, 0) * _COUNTS)
        if plausible and (counts is None or ticks <= _GAP * self._period):
            return Step(counter_jumped=counts is not None)
        # Both ends may be damaged a little. A clock that kept pace with the arrivals went on.
        off_ns = abs(held.arrival_ns - last.arrival_ns - ticks * TICK_NS)
        return Step(restarted=off_ns > _PACE_NS)

    def _follows(self, last: _Point, point: _Point) -> bool:
        ticks, counts = self._ticks(last, point), _counts(last, point)
        if (ticks is None) != (last.ticks is None) or (counts is None) != (last.counter is None):
            return False  # it lacks what the stream has, or has what the stream lacks
        few = _SLACK_COUNTS + 1
        if ticks is None:
            return counts is None or counts <= few + point.messages - last.messages
        if counts is None:
            return 0 <= ticks <= few * self._period
        return 0 <= ticks <= _DISTINCT * self._period and self._agree(ticks, counts)

    @property
    def _period(self) -> float:
        """Ticks a count; never 0."""
        if self._sum_counts < _LEARNED:
            return self._nominal
        return self._sum_ticks / self._sum_counts

    def _ticks(self, last: _Point, point: _Point) -> int | None:
        """Return the step of time with a wrap undone; None where either end has no time."""
        if last.ticks is None or point.ticks is None:
            return None
        step = point.ticks - last.ticks
        if step >= 0:
            return step
        counts = _counts(last, point)
        moduli = (WRAP_DAY, WRAP_32_BIT) if self.modulus is None else (self.modulus,)
        for modulus in moduli:
            true = step + modulus
            if 0 < true <= _PLAUSIBLE_GAP and (counts is None or self._agree(true, counts)):
                self.modulus = modulus
                return true
        return step

    def _agree(self, ticks: int, counts: int) -> bool:
        """Whether `ticks` and `counts` passed together, as far as the counter can show."""
        expected = round(ticks / self._period)
        off = (counts - expected) % _COUNTS
        return min(off, _COUNTS - off) <= _SLACK_COUNTS + _SLACK_SHARE * expected


def _counts(last: _Point, point: _Point) -> int | None:
    """Return the step of the counter; None where either end has none."""
    if last.counter is None or point.counter is None:
        return None
    return (point.counter - last.counter) % _COUNTS


def _lost(last: _Point, point: _Point) -> int:
    """Return the messages between two that never came."""
    counts = _counts(last, point)
    if counts is None or counts > _DISTINCT:  # the counter went back by a few
        return 0
    return max(counts - (point.messages - last.messages), 0)
