"""Counter and clock of an Xbus device: losses, restarts, and corruption that passed the checksum.

An orientation *follows* another orientation if counter and device time advanced together. If only
one of them is sent, its step must correspond to at most a few messages. Every MTData2 message
increments the counter. Only messages with an orientation are compared, because other messages may
contain the time of another clock (GNSS).

| orientation                                   | outcome                                         |
|-----------------------------------------------|-------------------------------------------------|
| follows the last accepted orientation         | accepted; skipped counts are lost messages      |
| does not follow                               | held until the next orientation                 |
| the next follows the last accepted one        | the held one is corrupt and is dropped          |
| the next follows the held one                 | both accepted; a restart if device time agrees  |
|                                               | neither with the counter nor with the arrivals, |
|                                               | and no backlog explains it; a counter jump if   |
|                                               | time advanced by one period; without device     |
|                                               | time, a restart if the counter decreased        |
| the next follows neither                      | the held one is dropped, the next one is held   |

The eight-bit checksum accepts one corrupt message in 256, so a single message proves neither a loss
nor a restart. The expected number of counts follows from the time and the measured rate. It may
differ from the counted number by four plus 2 % of the expected number, modulo 65536. The nominal
rate is used only for the first samples.

Invariant: the result depends only on the values fed, and every input is accepted.
"""

from __future__ import annotations

from typing import NamedTuple

from jointfit_drivers.backlog import BacklogDelay, device_continued
from jointfit_protocols.xbus.configuration import TICK_NS, WRAP_32_BIT, WRAP_DAY

_COUNTS = 1 << 16
_GAP = 1.5
"""Longest time between two messages at which a jump of the counter alone is accepted, in
periods."""
_PLAUSIBLE_GAP = 3600 * 1_000_000_000 // TICK_NS
"""Longest plausible gap, ticks. One hour is longer than any delay or buffer."""
_SLACK_COUNTS = 4
"""Number of counts by which counter and time may differ."""
_SLACK_SHARE = 0.02
"""Additional share of the elapsed counts by which counter and time may differ."""
_LEARNED = 10
"""Number of counts after which the measured rate replaces the nominal rate."""
_PACE_NS = 250_000_000
"""Largest difference between elapsed device time and elapsed arrival time without a restart or a
backlog, ns."""
_LATEST_NS = 30_000_000_000
"""Longest delay of the first messages after the port is opened, ns."""
_DISTINCT = 50_000
"""Longest gap over which counter and time are compared, counts.

The permitted difference grows with the gap. After a very long gap, it would include any pair of
counter and time."""


class XbusStep(NamedTuple):
    """Classification of one orientation."""

    lost: int = 0
    """Number of messages lost before this orientation, or before the held one if it is
    confirmed."""
    restarted: bool = False
    """Whether the device restarted before the held orientation."""
    held: bool = False
    """Whether this orientation must be held until the next orientation."""
    confirmed: bool = False
    """Whether the held orientation is valid and must be returned first; otherwise it is dropped."""
    lost_since: int = 0
    """Number of messages lost between the confirmed orientation and this one."""
    counter_jumped: bool = False
    """Whether only the counter jumped before the held orientation. In this case no message was
    lost."""


class _OrientationPoint(NamedTuple):
    """One orientation: counter, time, arrival, and number of messages received until then."""

    counter: int | None
    ticks: int | None
    arrival_ns: int
    messages: int


_CONTINUES = XbusStep()
_HELD = XbusStep(held=True)


class XbusContinuity:
    """Checks counter and time of one device.

    Parameters
    ----------
    rate_hz : float
        Nominal rate, Hz. It is used until the rate of the stream is measured.
    """

    def __init__(self, rate_hz: float) -> None:
        self.modulus: int | None = None
        """Number of ticks after which device time restarts at 0; None until the device model or the
        first wrap determines it."""
        self._nominal = 1_000_000_000 / TICK_NS / rate_hz
        self._messages = 0
        self._last: _OrientationPoint | None = None
        self._held: _OrientationPoint | None = None
        self._trusted = False  # whether a message followed the last one
        self._sum_ticks = self._sum_counts = 0
        self._delay = BacklogDelay()

    def other(self) -> None:
        """Count an MTData2 without orientation, which also increments the counter."""
        self._messages += 1

    def orientation(self, counter: int | None, ticks: int | None, arrival_ns: int) -> XbusStep:
        """Return the classification of a message with an orientation.

        Parameters
        ----------
        counter : int, optional
            Packet counter of the message.
        ticks : int, optional
            Device time of the message, in units of 100 us.
        arrival_ns : int
            Arrival time of the message, monotonic ns of the host.
        """
        self._messages += 1
        point = _OrientationPoint(counter, ticks, arrival_ns, self._messages)

        last, held = self._last, self._held
        if last is None:
            self._last = point
            return _CONTINUES

        if self._follows(last, point):
            self._held = None
            return self._accept(last, point)

        if held is None or not self._follows(held, point):
            self._held = point
            return _HELD

        # `held` and `point` follow each other, but do not follow `last`. Both are accepted.
        trusted, self._held = self._trusted, None
        step = self._classify(last, held) if trusted else _CONTINUES
        if step.restarted or not trusted:
            self._sum_ticks = self._sum_counts = 0
            self._delay = BacklogDelay()
        else:
            self._delay_to(last, held)
        return step._replace(confirmed=True, lost_since=self._accept(held, point).lost)

    def forget(self) -> None:
        """Discard the state, because the device reported a restart."""
        self._last = self._held = None
        self._trusted = False
        self._sum_ticks = self._sum_counts = 0
        self._delay = BacklogDelay()

    def _accept(self, last: _OrientationPoint, point: _OrientationPoint) -> XbusStep:
        """Store `point` as the last point, and update the measured rate."""
        self._last, self._trusted = point, True
        self._delay_to(last, point)

        counts, ticks = _counts(last, point), self._ticks(last, point)
        # The rate cannot be measured with a clock that does not advance.
        if counts and ticks and counts <= _DISTINCT:
            self._sum_ticks += ticks
            self._sum_counts += counts
        lost = _lost_count(last, point)
        return XbusStep(lost) if lost else _CONTINUES

    def _classify(self, last: _OrientationPoint, held: _OrientationPoint) -> XbusStep:
        """Return the classification of two points that do not follow each other."""
        ticks, counts = self._ticks(last, held), _counts(last, held)
        if ticks is None:  # without time, only a restart decreases the counter
            fell = counts is not None and counts > _DISTINCT
            return XbusStep(restarted=True) if fell else XbusStep(_lost_count(last, held))

        plausible = 0 <= ticks <= _PLAUSIBLE_GAP
        if counts is not None and plausible and self._agree(ticks, counts):
            turns = round((ticks / self._period - counts) / _COUNTS)
            return XbusStep(_lost_count(last, held) + max(turns, 0) * _COUNTS)
        if plausible and (counts is None or ticks <= _GAP * self._period):
            return XbusStep(counter_jumped=counts is not None)
        # Some bits of a message may be corrupt, or a backlog may have ended. The device restarted
        # only if device time also disagrees with the arrival times.
        elapsed_ns = held.arrival_ns - last.arrival_ns
        delay_ns = self._delay.limit(_PACE_NS, _LATEST_NS)
        continued = device_continued(delay_ns, ticks * TICK_NS, elapsed_ns, _PACE_NS)
        return XbusStep(restarted=not continued)

    def _delay_to(self, last: _OrientationPoint, point: _OrientationPoint) -> None:
        """Update the delay with a point on the same clock as the previous point."""
        ticks = self._ticks(last, point)
        if ticks is not None:
            self._delay.feed(ticks * TICK_NS, point.arrival_ns - last.arrival_ns)

    def _follows(self, last: _OrientationPoint, point: _OrientationPoint) -> bool:
        ticks, counts = self._ticks(last, point), _counts(last, point)
        if (ticks is None) != (last.ticks is None) or (counts is None) != (last.counter is None):
            return False  # `point` and `last` have different fields

        few = _SLACK_COUNTS + 1
        if ticks is None:
            return counts is None or counts <= few + point.messages - last.messages
        if counts is None:
            return 0 <= ticks <= few * self._period
        return 0 <= ticks <= _DISTINCT * self._period and self._agree(ticks, counts)

    @property
    def _period(self) -> float:
        """Number of ticks per count; never 0."""
        if self._sum_counts < _LEARNED:
            return self._nominal
        return self._sum_ticks / self._sum_counts

    def _ticks(self, last: _OrientationPoint, point: _OrientationPoint) -> int | None:
        """Return the step of device time, wraps removed; None if one of the points has no time."""
        if last.ticks is None or point.ticks is None:
            return None
        step = point.ticks - last.ticks
        if step >= 0:
            return step

        counts = _counts(last, point)
        moduli = (WRAP_DAY, WRAP_32_BIT) if self.modulus is None else (self.modulus,)
        for modulus in moduli:
            true = step + modulus
            off_ns = point.arrival_ns - last.arrival_ns - true * TICK_NS
            paced = abs(off_ns) <= _PACE_NS or true <= _DISTINCT * self._period
            if (
                0 < true <= _PLAUSIBLE_GAP
                and paced
                and (counts is None or self._agree(true, counts))
            ):
                self.modulus = modulus
                return true
        return step

    def _agree(self, ticks: int, counts: int) -> bool:
        """Return whether `ticks` and `counts` agree at the measured rate, modulo `_COUNTS`."""
        expected = round(ticks / self._period)
        off = (counts - expected) % _COUNTS
        return min(off, _COUNTS - off) <= _SLACK_COUNTS + _SLACK_SHARE * expected


def _counts(last: _OrientationPoint, point: _OrientationPoint) -> int | None:
    """Return the step of the counter; None if one of the points has no counter."""
    if last.counter is None or point.counter is None:
        return None
    return (point.counter - last.counter) % _COUNTS


def _lost_count(last: _OrientationPoint, point: _OrientationPoint) -> int:
    """Return the number of messages lost between two points."""
    counts = _counts(last, point)
    if counts is None or counts > _DISTINCT:  # the counter decreased slightly
        return 0
    return max(counts - (point.messages - last.messages), 0)
