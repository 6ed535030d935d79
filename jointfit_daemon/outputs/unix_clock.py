"""UNIX time of monotonic stamps. Law: follows the system's clock, and tells when it was set.

Both clocks run at the same rate, however NTP slews them, so their offset changes only when somebody
steps UNIX time. CLOCK_MONOTONIC also stands still while the host is suspended; that is a step, too.
"""

from __future__ import annotations

import time

STEP_NS = 2_000_000
"""A change of the offset by more than this is a step, and not a busy moment between two reads."""
_LOOKS = 5
_NS_PER_S = 1_000_000_000


class UnixClock:
    """The offset from CLOCK_MONOTONIC to UNIX time, measured at most once a second.

    Between measurements stamps keep their spacing; a step of the system's clock is followed
    within a second.
    """

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self._until_ns = -1
        self._step_ns = 0

    def offset_ns(self) -> int:
        """Return what to add to a monotonic stamp to get UNIX time."""
        now_ns, before_ns = time.monotonic_ns(), self._offset_ns
        if before_ns is not None and now_ns < self._until_ns:
            return before_ns
        self._until_ns = now_ns + _NS_PER_S
        offset_ns = min(_look() for _ in range(_LOOKS))[1]
        if before_ns is not None and abs(offset_ns - before_ns) > STEP_NS:
            self._step_ns += offset_ns - before_ns
        self._offset_ns = offset_ns
        return offset_ns

    def take_step_ns(self) -> int:
        """Return by how much UNIX time was set forward since this was last asked; mostly 0."""
        step_ns, self._step_ns = self._step_ns, 0
        return step_ns


def _look() -> tuple[int, int]:
    """Return how long the look took, and the offset in its middle, ns."""
    before_ns = time.monotonic_ns()
    unix_ns = time.time_ns()
    after_ns = time.monotonic_ns()
    return after_ns - before_ns, unix_ns - (before_ns + after_ns) // 2
