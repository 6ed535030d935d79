"""Time and motion of an x-IMU3: lost messages, restarts, and corruption that no checksum detects.

A message *follows* the last accepted message if its time advances by at most a few periods and its
orientation continues the motion. Three messages have the orientations q0, q1 and q2 and the times
t0, t1 and t2. Their deviation from a uniform motion, as an angle in rad, is

    E = 2 |q2 - q1 - (q1 - q0) (t2 - t1) / (t1 - t0)|.

If t2 - t1 is one period, the limit for E is 0.005 rad plus twice the largest E of the last seconds.
After n periods the limit is n^2 times as large. An acceleration of the sensor raises the limit.

| message                                       | outcome                                          |
|-----------------------------------------------|--------------------------------------------------|
| follows the last accepted message             | accepted; skipped periods are lost messages      |
| does not follow                               | held until the next message                      |
| the next follows the last accepted one        | the held one is corrupt and is dropped           |
| the next is at most a few periods after the   | both accepted; a restart if device time did not  |
| held one, and the rotation is possible        | advance like the arrival times                   |
| none of the above                             | the held one is dropped, the next one is held    |

Invariant: the result depends only on the values fed, and no input raises an exception. During a
motion within the range of the gyroscope, a message is held until the next message at most, and two
successive messages are never dropped.
"""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING, NamedTuple

from jointfit_drivers.backlog import BacklogDelay, device_continued

if TYPE_CHECKING:
    from jointfit_daemon.model import Quaternion

_FEW = 5.5
"""Largest number of periods between two successive messages."""
_FIRST_US = 1_000_000
"""Longest step of device time to the next message while the period is unknown, us. It permits a
device at 1 Hz."""
_EXTRAPOLATED = 2.5
"""Longest interval over which motion is extrapolated, in periods."""
_STEADY = 0.005
"""Deviation from a uniform motion that is always accepted, rad."""
_DECAY = 0.998
"""Factor by which the largest deviation decreases per message: one half in 3.5 s at 100 Hz."""
_FASTEST = 60.0
"""Largest angular rate between two messages, rad/s. The range of the gyroscope is 35 rad/s."""
_JOLT = 0.05
"""Additional rotation that is always permitted, rad."""
_LEARNED = 10
"""Smallest number of intervals whose mean is used as the period. With fewer intervals, the period
is the shortest interval."""
_LONGER = 20
"""If this number of consecutive intervals all last the same number of periods, and more than one,
the rate has changed."""
_MOST_COUNTED = 50
"""Longest interval that contributes to the mean, in periods."""
_PACE_NS = 250_000_000
"""Largest difference between elapsed device time and elapsed arrival time without a restart or a
backlog, ns."""
_LATEST_NS = 30_000_000_000
"""Longest delay of the first messages after the port is opened, ns."""


class XImu3Point(NamedTuple):
    """One measurement: device time, arrival and orientation."""

    ticks: int
    """Device time, us."""
    arrival_ns: int
    q: Quaternion | None = None
    """Unit quaternion in any world; None for raw measurements."""


class XImu3Step(NamedTuple):
    """Classification of one measurement."""

    lost: int = 0
    """Number of messages lost before this one, or before the held one if it is confirmed."""
    restarted: bool = False
    """Whether the device restarted before the held message."""
    held: bool = False
    """Whether this message must be held until the next message."""
    confirmed: bool = False
    """Whether the held message is valid and must be returned first; otherwise it is dropped."""
    lost_since: int = 0
    """Number of messages lost between the confirmed message and this message."""


_CONTINUES = XImu3Step()
_HELD = XImu3Step(held=True)


class XImu3Continuity:
    """Checks the measurements of one device."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Discard the state, so that the next message is treated as the first."""
        self._last: XImu3Point | None = None
        self._before: XImu3Point | None = None
        self._held: XImu3Point | None = None
        self._deviation = 0.0  # largest deviation of the last seconds, rad
        self._dropped = 0  # messages dropped since the last accepted one
        self._shortest = 0
        self._sum_us = self._sum_periods = 0
        self._longer = (0, 0)  # periods in each of the last intervals, and number of intervals
        self._delay = BacklogDelay()

    @property
    def period_us(self) -> float | None:
        """Mean interval of the messages, us; None until it is known."""
        return self._sum_us / self._sum_periods if self._sum_periods >= _LEARNED else None

    def step(self, point: XImu3Point) -> XImu3Step:
        """Return the classification of a message with a measurement."""
        last, held = self._last, self._held
        if last is None:
            self._last = point
            return _CONTINUES

        if self._follows(last, point):
            if held is not None:
                self._dropped, self._held = self._dropped + 1, None
            lost = self._accept(last, point)
            return XImu3Step(lost) if lost else _CONTINUES

        if held is None or not self._confirms(held, point):
            self._dropped += held is not None
            self._held = point
            return _HELD

        # `held` and `point` belong together, so both are accepted.
        self._held = None
        advance_ns, elapsed_ns = (held.ticks - last.ticks) * 1000, held.arrival_ns - last.arrival_ns
        delay_ns = self._delay.limit(_PACE_NS, _LATEST_NS)
        if not device_continued(delay_ns, advance_ns, elapsed_ns, _PACE_NS):
            self.forget()
            self._last = held
            return XImu3Step(restarted=True, confirmed=True, lost_since=self._accept(held, point))
        lost = self._accept(last, held)
        return XImu3Step(lost, confirmed=True, lost_since=self._accept(held, point))

    def _follows(self, last: XImu3Point, point: XImu3Point) -> bool:
        passed = point.ticks - last.ticks
        period = self._period
        if not 0 <= passed <= (_FEW * period if period else _FIRST_US):
            return False
        if not 0 < passed <= _EXTRAPOLATED * period:
            return True
        allowed = (2.0 * self._deviation + _STEADY) * max(1.0, (passed / period) ** 2)
        return self._deviation_of(last, point) <= allowed

    def _confirms(self, held: XImu3Point, point: XImu3Point) -> bool:
        """Return whether a message may be the next message after the held message."""
        passed = point.ticks - held.ticks
        if not 0 <= passed <= (_FEW * self._period if self._period else _FIRST_US):
            return False
        if held.q is None or point.q is None:
            return True

        # The angle between the orientations is about twice the distance of the quaternions.
        sign = 1.0 if sum(a * b for a, b in zip(held.q, point.q, strict=True)) >= 0.0 else -1.0
        square = sum((a - sign * b) ** 2 for a, b in zip(held.q, point.q, strict=True))
        return 2.0 * sqrt(square) <= _FASTEST * 1e-6 * passed + _JOLT

    def _deviation_of(self, last: XImu3Point, point: XImu3Point) -> float:
        """Return the deviation from a uniform motion, rad; 0 if it is unknown."""
        before, q = self._before, point.q
        if before is None or q is None or last.q is None or before.q is None:
            return 0.0
        passed, step = point.ticks - last.ticks, last.ticks - before.ticks
        if step <= 0:
            return 0.0

        (a, b, c, d), (e, f, g, h) = before.q, last.q
        if a * e + b * f + c * g + d * h < 0.0:
            a, b, c, d = -a, -b, -c, -d
        w, x, y, z = q
        if e * w + f * x + g * y + h * z < 0.0:
            w, x, y, z = -w, -x, -y, -z
        r = passed / step
        w, x, y, z = (
            w - e - (e - a) * r,
            x - f - (f - b) * r,
            y - g - (g - c) * r,
            z - h - (h - d) * r,
        )
        return 2.0 * sqrt(w * w + x * x + y * y + z * z)

    def _accept(self, last: XImu3Point, point: XImu3Point) -> int:
        """Store `point` as the last point; return the number of messages lost before it."""
        passed = point.ticks - last.ticks
        self._delay.feed(passed * 1000, point.arrival_ns - last.arrival_ns)
        dropped, self._dropped = self._dropped, 0
        if passed <= 0:
            self._last = point
            return 0

        deviation = self._deviation_of(last, point)
        self._before, self._last = last, point
        if not self._shortest or passed < 0.75 * self._period:
            self._shortest, self._sum_us, self._sum_periods = passed, 0, 0

        periods = round(passed / self._period)
        self._deviation = max(self._deviation * _DECAY, deviation / (periods * periods))
        if periods <= _MOST_COUNTED:
            self._sum_us += passed
            self._sum_periods += periods
        count = self._longer[1] + 1 if self._longer[0] == periods else 1
        self._longer = (periods, count)
        if periods > 1 and count >= _LONGER:
            self._shortest, self._sum_us, self._sum_periods = passed, 0, 0
            return 0
        return max(periods - 1 - dropped, 0) if self._sum_periods >= _LEARNED else 0

    @property
    def _period(self) -> float:
        """Best estimate of the period, us; 0 before the second message."""
        if self._sum_periods >= _LEARNED:
            return self._sum_us / self._sum_periods
        return self._shortest
