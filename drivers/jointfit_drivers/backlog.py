"""Delay of the messages of one device, relative to its fastest messages.

After a silence, buffered messages (a *backlog*) arrive together. All these messages are late. The
first message has the largest delay, and the last has the smallest. Device time and arrival time
then advance differently although the device continued to run. Between two messages, e is the
elapsed arrival time and d is the advance of device time. The delay L' of the second message follows
from the delay L of the first:

    L' = max(0, L + (1 - m) e - d),   m = 0.1 %.

The margin m prevents the skew of a slow device clock from accumulating as delay. After the port is
opened, the delay is unknown until messages have arrived at the device's own rate.

Invariant: the result depends only on the steps fed, in any unit of time. The module reads no clock.
"""

from __future__ import annotations

_SKEW = 0.001
"""Margin m, as a ratio. It is twice the largest plausible skew of a device clock."""
_BURST_SHARE = 0.5
"""Share of the advance d of device time. If L + (1 - m) e - d is below zero by more than this share
of d, the message arrived earlier than L permits. It is then part of a burst: messages arrive faster
than the device measures, and the delay is still unknown."""


class BacklogDelay:
    """Estimates the delay of the last message of one device."""

    __slots__ = ("_delay", "_paced")

    def __init__(self) -> None:
        self._delay = 0.0
        self._paced = 0.0  # elapsed arrival time since the last message of a burst

    def feed(self, advance: float, elapsed: float) -> None:
        """Add a message of a device that continued to run.

        Parameters
        ----------
        advance
            Step of device time since the previous message.
        elapsed
            Time between the arrivals of the two messages, in the same unit.
        """
        delay = self._delay + (1.0 - _SKEW) * elapsed - advance
        burst = -delay > _BURST_SHARE * advance
        self._paced = 0.0 if burst else self._paced + elapsed
        self._delay = max(0.0, delay)

    def limit(self, settle: float, unknown: float) -> float:
        """Return the largest possible delay of the last message.

        Parameters
        ----------
        settle
            Time with messages at the device's own rate after which the delay is known, in the unit
            of `feed`.
        unknown
            Smallest value that is returned until the delay is known, in the unit of `feed`.
        """
        return self._delay if self._paced >= settle else max(self._delay, unknown)


def device_continued(delay: float, advance: float, elapsed: float, tolerance: float) -> bool:
    """Return whether the arrival times and a backlog explain a step of device time.

    Device time may advance by more than the elapsed arrival time. The difference is at most the
    delay of the previous message, because no message arrives before it is sent.

    Parameters
    ----------
    delay
        Largest possible delay of the message before the step.
    advance
        Step of device time.
    elapsed
        Time between the arrivals of the two messages.
    tolerance
        Largest difference that needs no explanation. All four arguments have the same unit.
    """
    return -tolerance <= advance - elapsed <= delay + tolerance
