"""Check of device time for lost messages, restarts and corruption, without a message counter.

A message *follows* another message if device time did not decrease, and if device time advanced by
at most five periods or by about as much as the arrival time. The comparison with the arrival time
allows for a backlog of buffered messages.

| message                                       | outcome                                         |
|-----------------------------------------------|-------------------------------------------------|
| follows the last accepted message             | accepted; messages were lost if device time     |
|                                               | advanced by more than one and a half periods    |
| does not follow                               | held until the next message                     |
| the next follows the last accepted message    | the held message is corrupt and dropped         |
| the next follows the held message             | both are accepted; the clock restarted          |
| the next follows neither                      | the held message is dropped, the next is held   |

A checksum passes some corrupt messages, so a single message never proves a restart. The period of
the stream is determined from three steps of about the same size.

Invariant: the result depends only on the times fed, and no input raises an exception.
"""

from __future__ import annotations

from typing import NamedTuple

from jointfit_drivers.backlog import BacklogDelay, device_continued

_FEW = 5
"""Number of periods by which device time may always advance, regardless of the arrival time."""
_GAP = 1.5
"""Largest step without a lost message, in periods."""
_ALIKE = 0.3
"""Largest relative difference between two steps without a lost message."""
_STEPS = 3
"""Number of steps that determine the period."""
_GAIN = 0.125
"""Weight of a new step in the running mean of the period."""
_PACE_NS = 250_000_000
"""Largest difference between elapsed device time and elapsed arrival time without a restart or a
backlog, ns. The delay of the messages is known after messages have arrived at the device's own rate
for this time."""
_LATEST_NS = 30_000_000_000
"""Longest delay of the first messages after the port is opened, ns."""


class TimeStep(NamedTuple):
    """Classification of one message."""

    lost: int = 0
    """Number of messages lost before this message."""
    held: bool = False
    """Whether this message must be held until the next message."""
    restarted: bool = False
    """Whether the previously held message is valid, as the first message of a restarted clock."""


class _Instant(NamedTuple):
    device_ns: int
    arrival_ns: int


_CONTINUES, _HELD = TimeStep(), TimeStep(held=True)


class TimeContinuity:
    """Checks the clock of one device."""

    def __init__(self) -> None:
        self._last: _Instant | None = None
        self._held: _Instant | None = None
        self._period_ns = 0.0
        self._first_steps: list[int] = []
        self._delay = BacklogDelay()

    def add(self, device_ns: int, arrival_ns: int) -> TimeStep:
        """Return the classification of the next message.

        Parameters
        ----------
        device_ns : int
            Device time of the message, ns.
        arrival_ns : int
            Arrival time of the message, monotonic ns of the host.
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
        """Discard the state, so that the next message is treated as the first."""
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
        """Store `instant` as the last instant; return the number of messages lost before it."""
        self._last = instant
        step_ns = instant.device_ns - last.device_ns
        self._delay.feed(step_ns, instant.arrival_ns - last.arrival_ns)

        period_ns = self._period_ns
        if abs(step_ns - period_ns) <= _ALIKE * period_ns:
            self._period_ns += _GAIN * (step_ns - period_ns)
            if self._first_steps:
                self._first_steps.clear()
            return 0

        # A new period is used after three consecutive steps of about the same size.
        steps = self._first_steps
        if steps and abs(step_ns - steps[0]) > _ALIKE * steps[0]:
            steps.clear()
        if step_ns > 0:
            steps.append(step_ns)
        if len(steps) == _STEPS:
            self._period_ns = sum(steps) / _STEPS
            steps.clear()

        return round(step_ns / period_ns) - 1 if period_ns and step_ns > _GAP * period_ns else 0
