"""Conversion of kernel stamps (CLOCK_REALTIME) to CLOCK_MONOTONIC, including steps of the clock.

The kernel slews both clocks equally. Their difference therefore changes only if the wall clock is
stepped or the host is suspended. A packet that was stamped before a step may be read after it. For
`OLDEST_NS` after a step, the conversion tries both the current difference and the difference before
the step. It uses the difference that yields an instant in the recent past.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

STEP_NS = 1_000_000
"""Change of the difference above which the wall clock was stepped, not slewed, ns."""
OLDEST_NS = 2_000_000_000
"""Longest time that a packet waits in a socket that is being read, ns."""
_READINGS = 5
"""Number of readings of both clocks. The reading with the shortest duration is used."""


class WallClock:
    """Converts kernel stamps to the monotonic clock. Call `pair` before every read of packets.

    Parameters
    ----------
    monotonic_ns, unix_ns : callable
        The two clocks, ns, which tests replace.
    """

    def __init__(
        self,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        unix_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._monotonic_ns, self._unix_ns = monotonic_ns, unix_ns
        self._offset_ns = self._before_ns = self._difference()
        self._stepped_ns = monotonic_ns() - OLDEST_NS
        self.replaced = 0
        """Number of packets that got the time of the read, because the kernel's stamp was missing
        or did not correspond to an instant in the recent past."""

    def pair(self) -> int:
        """Measure the difference between the clocks; return the monotonic time, ns."""
        offset_ns, now_ns = self._difference(), self._monotonic_ns()
        if abs(offset_ns - self._offset_ns) > STEP_NS:
            self._before_ns, self._stepped_ns = self._offset_ns, now_ns
        self._offset_ns = offset_ns
        return now_ns

    def monotonic(self, stamp_ns: int, now_ns: int) -> int:
        """Return the monotonic time of a wall-clock stamp, ns; at most `now_ns`."""
        found = self._convert(stamp_ns, now_ns)
        if found is None:  # the clock may have been stepped since the last pairing
            self.pair()
            found = self._convert(stamp_ns, now_ns)
        if found is None:
            self.replaced += 1
            return now_ns
        return found

    def _convert(self, stamp_ns: int, now_ns: int) -> int | None:
        stepped = now_ns - self._stepped_ns < OLDEST_NS
        for offset_ns in (self._offset_ns, self._before_ns)[: 1 + stepped]:
            arrival_ns = stamp_ns - offset_ns
            if now_ns - OLDEST_NS <= arrival_ns <= now_ns + STEP_NS:
                return min(arrival_ns, now_ns)
        return None

    def _difference(self) -> int:
        """Return UNIX time minus monotonic time, ns, from the fastest of five readings."""
        best_width, best = 1 << 62, 0

        for _ in range(_READINGS):
            before = self._monotonic_ns()
            unix = self._unix_ns()
            after = self._monotonic_ns()
            if after - before < best_width:
                best_width, best = after - before, unix - (before + after) // 2
        return best
