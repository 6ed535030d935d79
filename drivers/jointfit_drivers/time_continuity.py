"""Clock of a device without a message counter: lost messages, restarts, and undetected corruption.

A message *follows* another one if device time did not decrease and advanced by a few periods, or as
the arrival times did, a backlog included.

| message                                       | outcome                                         |
|-----------------------------------------------|-------------------------------------------------|
| follows the last accepted one                 | accepted; messages were lost if device time     |
|                                               | advanced by more than one and a half periods    |
| does not follow                               | held until the next one                         |
| the next one follows the last accepted one    | the held one was corrupt and is dropped         |
| the next one follows the held one             | both accepted; the clock restarted              |
| the next one follows neither                  | the held one is dropped, the next one held      |

A checksum passes some corrupt messages, so a single message never proves a restart. The period of
the stream is determined by three steps of about the same size.

Invariant: integers in, steps out; every input is accepted.
"""

from __future__ import annotations

from typing import NamedTuple

from jointfit_drivers.backlog import BacklogDelay, device_continued

_FEW = 5
"""Periods by which device time may advance in any arrival time."""
_GAP = 1.5
"""Largest step, periods, without a lost message."""
_ALIKE = 0.3
"""Largest relative difference of steps without a lost message between them."""
_STEPS = 3
"""Steps that determine the period."""
_GAIN = 0.125
"""Gain of the running mean of the period."""
_PACE_NS = 250_000_000
"""Largest difference, ns, of elapsed device and arrival time without a restart or a backlog."""
_LATEST_NS = 30_000_000_000
"""Longest delay, ns, of the first messages after opening."""


class TimeStep(NamedTuple):
    """Classification of one message."""

    lost: int = 0
    """Number of messages lost before this one."""
    held: bool = False
    """Whether this message is to be held until the next message."""
    restarted: bool = False
    """Whether the held message is valid, comes first, and is the first of a restarted clock."""


class _Instant(NamedTuple):
    device_ns: int
    arrival_ns: int


_CONTINUES, _HELD = TimeStep(), TimeStep(held=True)


class TimeContinuity:
    """Tracks the clock of one device."""

    def __init__(self) -> None:
        self._last: _Instant | None = None
        self._held: _Instant | None = None
        self._period_ns = 0.0
        self._first_steps: list[int] = []
        self._delay = BacklogDelay()

    def add(self, device_ns: int, arrival_ns: int) -> TimeStep:
        """Return the step of the next message.

        Parameters
        ----------
        device_ns : int
            Device time of the message, ns.
        arrival_ns : int
            Arrival time of the message, host monotonic ns.
        """
        instant = _Instant(device_ns, arrival_ns)
        last, held = self._last, self._held
        if last is None:
            self._last = instant
            return _CONTINUES

        if self._follows(last, instant):
            self._held = None
            lost = self._accept(last, instant)
            return TimeStep(lost) if lost else _CONTINUES

        if held is None or not self._follows(held, instant):
            self._held = instant
            return _HELD

        self.forget()
        self._accept(held, instant)
        return TimeStep(restarted=True)

    def forget(self) -> None:
        """Start again with the next message."""
        self._last = self._held = None
        self._period_ns, self._first_steps = 0.0, []
        self._delay = BacklogDelay()

    def _follows(self, last: _Instant, instant: _Instant) -> bool:
        step_ns = instant.device_ns - last.device_ns
        if step_ns < 0:
            return False
        if step_ns <= _FEW * self._period_ns:
            return True
        elapsed_ns = instant.arrival_ns - last.arrival_ns
        return device_continued(
            self._delay.limit(_PACE_NS, _LATEST_NS), step_ns, elapsed_ns, _PACE_NS
        )

    def _accept(self, last: _Instant, instant: _Instant) -> int:
        """Store `instant` as the last instant; return the number of messages lost before."""
        self._last = instant
        step_ns = instant.device_ns - last.device_ns
        self._delay.feed(step_ns, instant.arrival_ns - last.arrival_ns)

        period_ns = self._period_ns
        if abs(step_ns - period_ns) <= _ALIKE * period_ns:
            self._period_ns += _GAIN * (step_ns - period_ns)
            if self._first_steps:
                self._first_steps.clear()
            return 0

        # The first period, or another one, counts from its third step on.
        steps = self._first_steps
        if steps and abs(step_ns - steps[0]) > _ALIKE * steps[0]:
            steps.clear()
        if step_ns > 0:
            steps.append(step_ns)
        if len(steps) == _STEPS:
            self._period_ns = sum(steps) / _STEPS
            steps.clear()

        return round(step_ns / period_ns) - 1 if period_ns and step_ns > _GAP * period_ns else 0
