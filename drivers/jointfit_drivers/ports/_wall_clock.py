"""Kernel stamps, CLOCK_REALTIME, turned into CLOCK_MONOTONIC, whatever becomes of the wall clock.

Law: arithmetic on readings of two clocks; no socket, no bus. Both clocks are slewed alike, so their
difference changes only when the wall clock is stepped (or when the host was suspended). What was
stamped before a step may be read after it: for as long as anything may wait in a socket a stamp is
tried with the difference of now and with that before the step, and the one counts that gives an
instant in the recent past.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

STEP_NS = 1_000_000
"""A difference that moved more than this was stepped, not slewed."""
OLDEST_NS = 2_000_000_000
"""Nothing waits longer in a socket that is read."""
_READINGS = 5  # of both clocks; the tightest counts


class WallClock:
    """Takes kernel stamps to the monotonic clock; call ``pair`` at every wake-up.

    Parameters
    ----------
    monotonic_ns, unix_ns
        The two clocks; for tests.
    """

    def __init__(
        self,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        unix_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._monotonic_ns, self._unix_ns = monotonic_ns, unix_ns
        self._offset_ns = self._before_ns = self._difference()
        self._stepped_ns = monotonic_ns() - OLDEST_NS
        self.soft = 0
        """Stamps replaced by the time of reading, because no difference explained them."""

    def pair(self) -> int:
        """Compare the clocks anew; return the monotonic one, ns."""
        offset_ns, now_ns = self._difference(), self._monotonic_ns()
        if abs(offset_ns - self._offset_ns) > STEP_NS:
            self._before_ns, self._stepped_ns = self._offset_ns, now_ns
        self._offset_ns = offset_ns
        return now_ns

    def monotonic(self, stamp_ns: int, now_ns: int) -> int:
        """Return a wall-clock stamp as monotonic ns, never later than `now_ns`."""
        found = self._explained(stamp_ns, now_ns)
        if found is None:  # stepped since the last pairing, perhaps
            self.pair()
            found = self._explained(stamp_ns, now_ns)
        if found is None:
            self.soft += 1
            return now_ns
        return found

    def _explained(self, stamp_ns: int, now_ns: int) -> int | None:
        stepped = now_ns - self._stepped_ns < OLDEST_NS
        for offset_ns in (self._offset_ns, self._before_ns)[: 1 + stepped]:
            arrival_ns = stamp_ns - offset_ns
            if now_ns - OLDEST_NS <= arrival_ns <= now_ns + STEP_NS:
                return min(arrival_ns, now_ns)
        return None

    def _difference(self) -> int:
        """Return UNIX minus monotonic time, ns, from the quickest of five readings."""
        best_width, best = 1 << 62, 0
        for _ in range(_READINGS):
            before = self._monotonic_ns()
            unix = self._unix_ns()
            after = self._monotonic_ns()
            if after - before < best_width:
                best_width, best = after - before, unix - (before + after) // 2
        return best
