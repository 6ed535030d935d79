"""Conversion of the calendar time of a WitMotion device to a continuous time.

The clock starts at an arbitrary date and may glitch. A time that contradicts the arrivals is not
used. If the next times continue the rejected time, the clock was set, and its times are used again.

Invariant: the result depends only on the times and arrivals fed.
"""

from __future__ import annotations

from jointfit_protocols.witmotion import TICK_NS

_SLACK_NS = 1_000_000_000
"""Largest difference between elapsed device time and elapsed arrival time without a glitch, ns. It
exceeds the delay of buffered bytes."""
_CONFIRMED = 3
"""Number of consecutive times after a step that prove that the clock was set."""


class CalendarTime:
    """Checks the calendar time of one device."""

    def __init__(self) -> None:
        self._last: tuple[int, int] | None = None  # accepted ticks and their arrival
        self._doubted: tuple[int, int] | None = None
        self._confirmed = 0
        self._reading: int | None = None
        self._reading_ns = 0

    def accept(self, ticks: int | None, arrival_ns: int) -> int | None:
        """Return the time of a sample, ms since 2000; None if the time is missing or a glitch.

        Parameters
        ----------
        ticks
            Time as sent, ms since 2000; None if the value is not a time.
        arrival_ns
            Arrival time of the sample, monotonic ns.
        """
        if ticks is None:
            return None
        if self._last is None or _follows(self._last, ticks, arrival_ns):
            self._last, self._doubted, self._confirmed = (ticks, arrival_ns), None, 0
            return ticks

        follows = self._doubted is not None and _follows(self._doubted, ticks, arrival_ns)
        self._confirmed = self._confirmed + 1 if follows else 0
        self._doubted = (ticks, arrival_ns)
        if self._confirmed < _CONFIRMED:
            return None
        self._last, self._doubted, self._confirmed = (ticks, arrival_ns), None, 0
        return ticks

    def reading_ns(self, ticks: int | None, period_ns: float) -> int:
        """Return the continuous time of a raw reading, ns. The zero of this time is arbitrary.

        Parameters
        ----------
        ticks
            Accepted time of the sample, ms; None if the time was a glitch.
        period_ns
            Mean interval of the readings, ns. It replaces a missing or implausible interval.
        """
        passed_ns = round(period_ns)
        if ticks is not None and self._reading is not None and ticks > self._reading:
            passed_ns = (ticks - self._reading) * TICK_NS
        self._reading_ns += passed_ns
        self._reading = ticks
        return self._reading_ns


def _follows(last: tuple[int, int], ticks: int, arrival_ns: int) -> bool:
    """Return whether device time and arrival time advanced equally."""
    advance_ns = (ticks - last[0]) * TICK_NS
    return advance_ns >= 0 and abs(advance_ns - (arrival_ns - last[1])) <= _SLACK_NS
