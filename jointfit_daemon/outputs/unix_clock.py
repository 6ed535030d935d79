"""UNIX time of monotonic stamps. Law: follows the system's clock, and knows when it was set.

Both clocks run at the same rate, however NTP slews them, so their offset changes only when somebody
steps UNIX time. CLOCK_MONOTONIC also stands still while the host is suspended; that is a step, too.
"""

from __future__ import annotations

import time
from typing import NamedTuple

STEP_NS = 50_000
"""A change of the offset by more than this, and by more than the looks may err, is a step."""
_LOOKS = 5
_NS_PER_S = 1_000_000_000


class _Look(NamedTuple):
    """One comparison of both clocks."""

    width_ns: int
    """How long it took: twice what it may err by."""
    offset_ns: int


class UnixClock:
    """The offset from CLOCK_MONOTONIC to UNIX time, measured at most once a second.

    Between steps stamps keep their spacing; a step of the system's clock is followed within a
    second.
    """

    def __init__(self) -> None:
        self._look: _Look | None = None
        self._until_ns = -1
        self._told_ns: int | None = None

    def offset_ns(self) -> int:
        """Return what to add to a monotonic stamp to get UNIX time."""
        now_ns, before = time.monotonic_ns(), self._look
        if before is not None and now_ns < self._until_ns:
            return before.offset_ns
        self._until_ns = now_ns + _NS_PER_S
        look = min(_looked() for _ in range(_LOOKS))
        if before is not None:
            slack_ns = STEP_NS + (look.width_ns + before.width_ns) // 2
            if abs(look.offset_ns - before.offset_ns) <= slack_ns:
                return before.offset_ns
        self._look = look
        return look.offset_ns

    def news_ns(self) -> int | None:
        """Return the offset if it is another than this has told before; mostly None."""
        offset_ns = self.offset_ns()
        if offset_ns == self._told_ns:
            return None
        self._told_ns = offset_ns
        return offset_ns


def _looked() -> _Look:
    before_ns = time.monotonic_ns()
    unix_ns = time.time_ns()
    after_ns = time.monotonic_ns()
    return _Look(after_ns - before_ns, unix_ns - (before_ns + after_ns) // 2)
