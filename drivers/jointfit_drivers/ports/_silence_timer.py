"""A timer that detects the silence of one device.

Invariant: an arrival costs only one reading of the clock. The first arrival restarts the event
loop's timer if `first_s` is longer than `silence_s`. No later arrival restarts the timer. If the
event loop's timer ends before the permitted silence is over, it is restarted for the remaining
time.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class SilenceTimer:
    """Calls `silent` when nothing has arrived for `silence_s`. The timer starts at its creation.

    Parameters
    ----------
    silence_s : float
        Permitted time without data after an arrival, s.
    silent : callable
        Function that is called at most once, from the event loop.
    first_s : float, optional
        Permitted time before the first arrival, s. The default is `silence_s`.
    """

    __slots__ = ("_armed_s", "_due_s", "_now", "_silence_s", "_silent", "_timer")

    def __init__(
        self, silence_s: float, silent: Callable[[], None], first_s: float | None = None
    ) -> None:
        self._now = asyncio.get_running_loop().time
        self._silence_s, self._silent = silence_s, silent
        self._timer: asyncio.TimerHandle | None = None
        self._due_s = self._now() + (silence_s if first_s is None else first_s)
        self._arm()

    def note_arrival(self) -> None:
        """Permit `silence_s` without data from now on."""
        self._due_s = self._now() + self._silence_s
        if self._due_s < self._armed_s and self._timer is not None:
            self._arm()  # the wait for the first arrival was longer

    def cancel(self) -> None:
        """Stop the timer; later arrivals have no effect."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _arm(self) -> None:
        self.cancel()
        self._armed_s = self._due_s
        self._timer = asyncio.get_running_loop().call_at(self._due_s, self._check)

    def _check(self) -> None:
        self._timer = None
        if self._now() < self._due_s:
            self._arm()
        else:
            self._silent()
