"""Log lines about sensors without data, limited to one line per sensor and outage.

When a silent source is closed, a log line states the reason. Fusion detects the missing data
earlier, so the line about the sensor would come first. The line about the sensor is therefore
delayed until the source can no longer be closed because of this silence. If the source still sends
data, it is not closed, and the line is written. A stall of the host has its own line. After a
stall, the lines are delayed until the sensors may have recovered.

Invariant: the line about a lost sensor whose source stays open is written within `LONGEST_S`, even
if the host stalls continuously.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from jointfit_daemon.pipeline.events import Notice, NoticeKind

RECOVERY_S = 4.0
"""Time after a stall of the event loop within which sensors recover, s: 2 s to process the delayed
data, and 2 s without a fault."""
LONGEST_S = 30.0
"""Longest time for which stalls may delay a line, s."""


@dataclass(slots=True)
class _HeldLine:
    due_s: float
    latest_s: float
    """Time after which stalls no longer delay the line, s."""
    notice: Notice


class OutageLines:
    """Delays notices about lost sensors, because some of them need no log line."""

    def __init__(self) -> None:
        self._held: dict[str, _HeldLine] = {}
        self._stalled_s = -inf

    def holds(self, notice: Notice, now_s: float, wait_s: float | None) -> bool:
        """Return whether the line for `notice` must be delayed or omitted.

        Parameters
        ----------
        notice
            Notice of the core, of any kind.
        now_s
            Current monotonic time, s.
        wait_s
            Longest time until the sensor's source is closed, s; None if the source is closed.
        """
        if notice.kind != NoticeKind.SENSOR:
            return False
        if notice.data.get("state") == "lost":
            due_s = inf if wait_s is None else now_s + wait_s
            due_s = max(due_s, self._stalled_s + RECOVERY_S)
            self._held[notice.id] = _HeldLine(due_s, now_s + LONGEST_S, notice)
            return True
        # A short pause in the data has ended; it is reported as a gap.
        return self._held.pop(notice.id, None) is not None and notice.data.get("state") == "ok"

    def close(self, source: str) -> None:
        """Drop the line about the sensor of a closed source, because the closing is logged."""
        self._held.pop(source, None)

    def postpone(self, now_s: float) -> None:
        """Process a stall of the host at `now_s`, which explains why sensors are lost."""
        self._stalled_s = now_s
        for line in self._held.values():
            recovered_s = min(now_s + RECOVERY_S, line.latest_s)
            line.due_s = max(line.due_s, recovered_s)

    def due(self, now_s: float) -> list[Notice]:
        """Return the notices whose sources were not closed in time.

        Each notice is returned once.
        """
        found = [name for name, line in self._held.items() if now_s >= line.due_s]
        return [self._held.pop(name).notice for name in found]
