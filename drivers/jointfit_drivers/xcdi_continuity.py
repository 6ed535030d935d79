"""Counter and time of an XCDI sensor: what was lost, whether it restarted, whether there are two.

Law: integers in, verdicts out. With d the step of SampleTime and c the step of GroupCounter since
the previous group, both modulo their widths, and P the step of one group as the stream showed it:

| seen                                                    | verdict                             |
|---------------------------------------------------------|-------------------------------------|
| c = round(d / P) within 1 % and a few counts            | same clock; c - 1 groups were lost  |
| no counter, d forward and under an hour                 | same clock; round(d / P) - 1 lost   |
| d or c backward, one still and the other not, or at odds| restart                             |
| three restarts, or ten broken groups, within 20 groups  | two sensors share the identifiers   |

A sensor that is reset restarts once. Two sensors contradict each other for ever: their groups
cannot be told apart, so nothing of them may be used.
"""

from __future__ import annotations

from collections import deque
from statistics import median
from typing import NamedTuple

from jointfit_protocols.xcdi import COUNTER_MODULUS, TICKS_MODULUS

_LEARNED = 10  # steps that show the stream's own period
_SLACK_COUNTS = 4
_SLACK_SHARE = 0.01
_LONGEST_GAP_S = 3600.0
_WINDOW = 20  # groups
_RESTARTS = 3
_BROKEN = 10


class Step(NamedTuple):
    """What happened since the previous group."""

    lost: int = 0
    restarted: bool = False
    shared: bool = False
    """Two sensors speak: this group may be a mixture."""


_GOES_ON = Step()


class Continuity:
    """Follows the groups of one sensor.

    Parameters
    ----------
    rate_hz
        Nominal rate; it only bounds how long a gap may be.
    """

    def __init__(self, rate_hz: float) -> None:
        self._longest = _LONGEST_GAP_S * rate_hz
        self._ticks: int | None = None
        self._counter: int | None = None
        self._groups = 0  # since the last group that had time, as the counter says
        self._uncounted = 0  # groups that came, or are known lost, since the last counter
        self._counted = False  # every group since then had a counter
        self._steps: list[float] = []
        self._period: float | None = None
        self._restarts: deque[bool] = deque(maxlen=_WINDOW)
        self._broken: deque[bool] = deque(maxlen=_WINDOW)
        self._quiet = 0  # groups since one that restarted or was broken
        self.shared = False

    def group(self, ticks: int | None, counter: int | None, *, broken: bool) -> Step:
        """Take one group; `broken`: it, or what came before it, was incomplete."""
        step = self._step(ticks, counter)
        self._restarts.append(step.restarted)
        self._broken.append(broken)
        self._quiet = 0 if step.restarted or broken else self._quiet + 1
        was_shared = self.shared
        if self._quiet >= _WINDOW and not was_shared:
            return step  # as nearly always: both windows hold nothing
        contradictions = sum(self._restarts)
        if contradictions >= _RESTARTS or sum(self._broken) >= _BROKEN:
            self.shared = True
        elif not contradictions and not any(self._broken):
            self.shared = False
        if self.shared:
            return Step(shared=True)
        return Step(restarted=True) if was_shared else step  # what comes now is one sensor again

    def _step(self, ticks: int | None, counter: int | None) -> Step:
        count = self._count(counter)
        if count is not None and count > COUNTER_MODULUS // 2:
            return self._restart(ticks, counter)
        lost = 0 if count is None else max(count - 1 - self._uncounted, 0)
        self._groups += count or 0
        self._counted = self._counted and count is not None
        if ticks is None or self._ticks is None:
            return self._remember(ticks, counter, lost)
        d = (ticks - self._ticks) % TICKS_MODULUS
        groups = self._groups if self._counted else None
        if d >= TICKS_MODULUS // 2 or (groups is not None and (d == 0) != (groups == 0)):
            return self._restart(ticks, counter)
        if self._period is None:
            self._learn(d, groups)
            return self._remember(ticks, counter, lost)
        expected = round(d / self._period)
        if not self._agree(expected, groups):
            return self._restart(ticks, counter)
        if count is None:
            lost = max(expected - 1, 0)
        return self._remember(ticks, counter, lost)

    def _count(self, counter: int | None) -> int | None:
        """Return the step of the counter; None where either end is missing."""
        if counter is None or self._counter is None:
            return None
        return (counter - self._counter) % COUNTER_MODULUS

    def _agree(self, expected: int, groups: int | None) -> bool:
        """Whether a time step worth `expected` groups can be that of `groups` counts."""
        if groups is None:
            return expected <= self._longest
        off = abs(groups - expected) % COUNTER_MODULUS
        return min(off, COUNTER_MODULUS - off) <= _SLACK_COUNTS + _SLACK_SHARE * expected

    def _learn(self, d: int, groups: int | None) -> None:
        self._steps.append(d / groups if groups else d)
        if len(self._steps) >= _LEARNED:
            self._period = median(self._steps) or None
            self._steps.clear()

    def _restart(self, ticks: int | None, counter: int | None) -> Step:
        self._ticks = self._counter = self._period = None
        self._steps.clear()
        self._remember(ticks, counter, 0)
        return Step(restarted=True)

    def _remember(self, ticks: int | None, counter: int | None, lost: int) -> Step:
        if counter is None:
            self._uncounted += 1 + lost  # its next step includes them
        else:
            self._counter, self._uncounted = counter, 0
        if ticks is not None:
            self._ticks, self._groups = ticks, 0
            self._counted = counter is not None
        return Step(lost) if lost else _GOES_ON
