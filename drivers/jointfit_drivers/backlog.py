"""Delay of the messages of one device, relative to its fastest messages.

After a silence, buffered messages arrive together: all of them are late, the last one by the least.
Device time and arrival time then advance differently although the device continued. With e the
elapsed arrival time and d the advance of device time between two messages, the delay of the second
is

    L' = max(0, L + (1 - m) e - d),   m = 0.1 %.

The margin m keeps the skew of a slow device clock from accumulating as delay. After opening, the
delay is unknown until messages have arrived at their own pace.

Invariant: a function of the steps fed, without a clock of its own; any unit of time.
"""

from __future__ import annotations

_SKEW = 0.001
"""Margin m, relative; twice the largest plausible skew of a device clock."""
_BURST_SHARE = 0.5
"""A delay below the shortest one by more than this share of the advance shows a burst."""


class BacklogDelay:
    """Delay of the last message of one device."""

    __slots__ = ("_delay", "_paced")

    def __init__(self) -> None:
        self._delay = 0.0
        self._paced = 0.0  # time since the shortest delay was found

    def feed(self, advance: float, elapsed: float) -> None:
        """Add a message of a device that continued.

        Parameters
        ----------
        advance
            Step of device time since the message before it.
        elapsed
            Time between their arrivals, in the same unit.
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
            Time at the device's own pace after which the delay is known.
        unknown
            Limit until then.
        """
        return self._delay if self._paced >= settle else max(self._delay, unknown)


def device_continued(delay: float, advance: float, elapsed: float, tolerance: float) -> bool:
    """Return whether a backlog and the arrival times explain a step of device time.

    Device time may advance more than the arrival times by at most the delay of the message before
    it: no message arrives before it was sent.

    Parameters
    ----------
    delay
        Largest possible delay of the message before the step.
    advance
        Step of device time.
    elapsed
        Time between the arrivals.
    tolerance
        Largest error of the comparison; all four in the same unit.
    """
    return -tolerance <= advance - elapsed <= delay + tolerance
