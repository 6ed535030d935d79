"""Counter and time of an XCDI sensor: lost groups, restarts, and shared identifiers.

A group consists of the CAN frames of one sample. In the table, d and c are the steps of SampleTime
and GroupCounter since the previous group, each modulo its number of values. P is the measured step
of SampleTime per group:

| finding                                                 | outcome                             |
|---------------------------------------------------------|-------------------------------------|
| c and n = round(d / P) differ by at most 2 + n / 100    | same clock; c - 1 groups were lost  |
| no counter, d forward by a few P                        | same clock; round(d / P) - 1 lost   |
| d or c backward, only one of them 0, or they disagree   | contradiction: the group is held    |
| the next group continues the held one                   | restart, unless SampleTime          |
|                                                         | continued or followed host time, or |
|                                                         | a backlog ended                     |
| the next group continues the last accepted one          | the held one was corrupt            |
| three contradictions that continue each other, or       | two sensors share the identifiers   |
| 14 broken groups, within 20 groups                      |                                     |

The serial line of a CAN adapter has no checksum, so a single group does not prove a restart. A
sensor that is reset contradicts the previous groups once. Two sensors with the same identifiers
contradict each other continuously. Their groups cannot be separated, so no group is used. A group
is *broken* if it or the group before it lacks a frame.

Invariant: the result depends only on the values fed, and every input is accepted.
"""

from __future__ import annotations

from collections import deque
from statistics import median
from typing import NamedTuple

from jointfit_drivers.backlog import BacklogDelay, device_continued
from jointfit_protocols.xcdi import COUNTER_MODULUS, TICKS_MODULUS

_LEARNED = 10
"""Number of steps after which the measured period is used."""
_SLACK_COUNTS = 2
_NEAR = 10
"""Largest difference between the steps of counter and time that counts as corruption, not as a
jump, in groups."""
_SLACK_SHARE = 0.01
_SILENT = _NEAR + 1
"""Shortest silence over which SampleTime is compared with host time, groups."""
_RAN_ON_SHARE = 0.1
"""Largest difference between SampleTime and host time over a silence, relative to the silence."""
_LATEST = 3000
"""Longest delay of the first groups after the bus is opened, groups."""
_LONGEST = 20_000
"""Longest accepted gap, groups. The tolerance grows with the gap. After a very long gap, it would
include any pair of values."""
_BLIND = 100
"""Longest gap that is accepted from the time alone if the next group confirms it, groups."""
_WINDOW = 20
"""Number of groups over which contradictions are counted."""
_CONTRADICTIONS = 3
_BROKEN = 14
_ASTRAY = 8
"""Number of consecutive contradictions after which, if no second sensor explains them, the period
is measured again."""


class XcdiStep(NamedTuple):
    """Classification of one group."""

    lost: int = 0
    """Number of groups lost before this group, or before the held group if it is confirmed."""
    restarted: bool = False
    """Whether the sensor restarted before the held group."""
    shared: bool = False
    """Whether two sensors use the same identifiers. In this case the group may mix their frames."""
    held: bool = False
    """Whether this group must be held until the next group."""
    confirmed: bool = False
    """Whether the held group is valid and must be returned first; otherwise it is dropped."""
    lost_since: int = 0
    """Number of groups lost between the confirmed group and this group."""


_CONTINUES = XcdiStep()
_HELD = XcdiStep(held=True)


class XcdiContinuity:
    """Checks the groups of one sensor."""

    def __init__(self) -> None:
        self._track = _Track()
        self._held: _Track | None = None
        self._rival: _Track | None = None  # the last contradictions that continue each other
        self._astray = 0
        self._contradictions: deque[bool] = deque(maxlen=_WINDOW)
        self._broken: deque[bool] = deque(maxlen=_WINDOW)
        self._quiet = 0  # groups since the last contradiction or broken group
        self.shared = False

    def group(
        self,
        ticks: int | None,
        counter: int | None,
        *,
        broken: bool,
        host_ticks: int | None = None,
    ) -> XcdiStep:
        """Return the classification of one group.

        Parameters
        ----------
        ticks, counter : int, optional
            SampleTime and GroupCounter of the group.
        broken : bool
            Whether this group or the previous group was incomplete.
        host_ticks : int, optional
            Arrival time of the group in ticks of the device; None while the tick is unknown.
        """
        step, rivals = self._step(ticks, counter, host_ticks)
        self._contradictions.append(rivals)
        self._broken.append(broken)
        self._quiet = 0 if rivals or broken else self._quiet + 1
        was_shared = self.shared
        if self._quiet >= _WINDOW and not was_shared:
            return step  # the usual case: both windows are empty

        contradictions = sum(self._contradictions)
        if contradictions >= _CONTRADICTIONS or sum(self._broken) >= _BROKEN:
            self.shared = True
        elif not contradictions and not any(self._broken):
            self.shared = False

        if self.shared:
            return XcdiStep(shared=True)
        return XcdiStep(restarted=True) if was_shared else step  # one sensor remains

    def _step(
        self, ticks: int | None, counter: int | None, host: int | None
    ) -> tuple[XcdiStep, bool]:
        """Return the classification, and whether the group continues earlier contradictions."""
        if self._track.continues(ticks, counter):
            self._held, self._astray = None, 0
            lost = self._track.take(ticks, counter, host)
            return (XcdiStep(lost) if lost else _CONTINUES), False

        held, self._held = self._held, None
        if held is not None and held.continues(ticks, counter):
            self._astray = 0
            groups, settled = self._track.groups_to(held), self._track.settled
            restarted = groups is None and settled and not self._track.ran_on_to(held)
            if not restarted:
                held.delay = self._track.delay_to(held)
            lost, since = (groups or 1) - 1, held.take(ticks, counter, host)
            self._track, self._rival = held, None
            step = XcdiStep(lost, restarted=restarted, confirmed=True, lost_since=since)
            return step, False

        self._astray += 1
        rival = self._rival
        rivals = rival is not None and rival.continues(ticks, counter)
        if rival is None or not rivals:
            rival = self._rival = _Track(self._track.period)
        rival.take(ticks, counter, host)

        if self._astray >= _ASTRAY:
            self._astray = 0
            self._track = _Track()
            self._track.take(ticks, counter, host)
            return XcdiStep(restarted=True), rivals

        self._held = _Track(self._track.period)
        self._held.take(ticks, counter, host)
        return _HELD, rivals


class _Track:
    """Sequence of groups that continue each other.

    Parameters
    ----------
    period : float, optional
        Number of ticks per group; None if it is unknown.
    """

    def __init__(self, period: float | None = None) -> None:
        self.period = period
        self.settled = period is not None
        """Whether the period was determined from enough steps."""
        self.delay = BacklogDelay()
        """Delay of the last group, ticks."""
        self._ticks: int | None = None
        self._host: int | None = None  # arrival of the last group with time, ticks
        self._counter: int | None = None
        self._groups = 0  # groups since the last group with time, by the counter
        self._uncounted = 0  # groups received, or known to be lost, since the last GroupCounter
        self._counted = False  # whether every group since the last group with time had a counter
        self._steps: list[float] = []

    def continues(self, ticks: int | None, counter: int | None) -> bool:
        """Return whether a group may be the next group of this sensor."""
        count = self._count(counter)
        if count is not None and count > COUNTER_MODULUS // 2:
            return False
        if ticks is None or self._ticks is None:
            few = self._uncounted + (_BLIND if self._ticks is None else _SLACK_COUNTS)
            return count is None or count <= 1 + few

        d = (ticks - self._ticks) % TICKS_MODULUS
        groups = self._groups + count if self._counted and count is not None else None
        if d >= TICKS_MODULUS // 2 or (groups is not None and (d == 0) != (groups == 0)):
            return False
        if self.period is None:
            return count is None or count <= 1 + self._uncounted + _SLACK_COUNTS

        expected = round(d / self.period)
        if groups is None and count is not None:
            groups = count - self._uncounted
        if groups is None:
            return expected <= 1 + _SLACK_COUNTS

        off = abs(groups - expected) % COUNTER_MODULUS
        near = min(off, COUNTER_MODULUS - off) <= _SLACK_COUNTS + _SLACK_SHARE * expected
        return near and expected <= _LONGEST

    def groups_to(self, later: _Track) -> int | None:
        """Return the number of groups from this track to a later track that does not continue it.

        Return None if time or counter jumped, or if a time or the period is unknown. A small
        difference between time and counter counts as corruption, and the result is 1.
        """
        if self._ticks is None or later._ticks is None or self.period is None:
            return None

        half = TICKS_MODULUS // 2
        passed = round(((later._ticks - self._ticks + half) % TICKS_MODULUS - half) / self.period)
        count = self._count(later._counter)

        off = 0 if count is None else abs(count - passed) % COUNTER_MODULUS
        is_near = min(off, COUNTER_MODULUS - off) <= _NEAR
        if abs(passed) > _BLIND or not is_near:
            return None
        return max(passed, 1) if count is None else 1

    def ran_on_to(self, later: _Track) -> bool:
        """Return whether SampleTime advanced by the time between the arrivals.

        In this case the clock continued during a silence or a backlog. The sensor did not restart,
        even if its counter did not advance.
        """
        if self._ticks is None or later._ticks is None or self.period is None:
            return False

        step = self._step_to(later._ticks, later._host)
        if step is None:  # without arrival times, a delay of the first groups is assumed
            advance = (later._ticks - self._ticks) % TICKS_MODULUS
            return advance <= _LATEST * self.period

        advance, elapsed = step
        delay = self.delay.limit(_SILENT * self.period, _LATEST * self.period)
        silence = elapsed + delay
        near = device_continued(delay, advance, elapsed, _RAN_ON_SHARE * silence)
        return near and silence >= _SILENT * self.period

    def delay_to(self, later: _Track) -> BacklogDelay:
        """Return the delay of a later track on the same clock."""
        step = self._step_to(later._ticks, later._host)
        if step is not None:
            self.delay.feed(*step)
        return self.delay

    def _step_to(self, ticks: int | None, host: int | None) -> tuple[int, int] | None:
        """Return the steps of SampleTime and of host time; None if one of them is unknown."""
        if self._ticks is None or ticks is None or self._host is None or host is None:
            return None
        return (ticks - self._ticks) % TICKS_MODULUS, host - self._host

    def take(self, ticks: int | None, counter: int | None, host: int | None) -> int:
        """Add a group that continues this track; return the number of groups lost before it."""
        count = self._count(counter)
        lost = 0 if count is None else max(count - 1 - self._uncounted, 0)

        self._groups += count or 0
        self._counted = self._counted and count is not None
        step = self._step_to(ticks, host)
        if step is not None:
            self.delay.feed(*step)
        if ticks is not None and self._ticks is not None:
            d = (ticks - self._ticks) % TICKS_MODULUS
            if not self.settled:
                self._steps.append(d / self._groups if self._counted and self._groups else d)
                self.period = median(self._steps) or None
                self.settled = len(self._steps) >= _LEARNED
            if count is None and self.settled and self.period:
                lost = max(round(d / self.period) - 1, 0)

        if counter is None:
            self._uncounted += 1 + lost  # the counter's next step includes them
        else:
            self._counter, self._uncounted = counter, 0
        if ticks is not None:
            self._ticks, self._groups, self._host = ticks, 0, host
            self._counted = counter is not None
        return lost

    def _count(self, counter: int | None) -> int | None:
        """Return the step of the counter; None if one of the groups has no counter."""
        if counter is None or self._counter is None:
            return None
        return (counter - self._counter) % COUNTER_MODULUS
