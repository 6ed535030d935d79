"""Log lines about sensors without data: one line for each sensor and outage.

When a silent source is closed, a log line gives the reason. Fusion detects missing data earlier, so
the line about the sensor would be the first. This line is therefore delayed until the silence can
no longer close the source. A source that still sends data is not closed. A stall of this host has
its own line; after a stall, the lines are delayed until the sensors may have recovered.

Invariant: the line about a lost sensor is written within `LONGEST_S`, even if the host stalls
continuously.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from jointfit_daemon.pipeline.events import Notice, NoticeKind

RECOVERY_S = 4.0
"""Time after a stall of the event loop in which sensors recover, s. It consists of 2 s without a
fault, and 2 s to process the delayed data."""
LONGEST_S = 30.0
"""Longest time for which stalls postpone a line, s."""


@dataclass(slots=True)
class _HeldLine:
    due_s: float
    latest_s: float
    """Time from which stalls no longer postpone the line."""
    notice: Notice


class OutageLines:
    """Delays the notices about lost sensors that may need no line."""

    def __init__(self) -> None:
        self._held: dict[str, _HeldLine] = {}
        self._stalled_s = -inf

    def holds(self, notice: Notice, now_s: float, wait_s: float | None) -> bool:
        """Return whether no line is written for `notice` now.

        Parameters
        ----------
        notice
            Any notice of the core.
        now_s
            Monotonic time, s.
        wait_s
            Longest time until the source of the sensor is closed, s; None if it is closed.
        """
        if notice.kind != NoticeKind.SENSOR:
            return False
        if notice.data.get("state") == "lost":
            due_s = inf if wait_s is None else now_s + wait_s
            due_s = max(due_s, self._stalled_s + RECOVERY_S)
            self._held[notice.id] = _HeldLine(due_s, now_s + LONGEST_S, notice)
            return True
        # A pause in the data that ended in time is reported as a gap.
        return self._held.pop(notice.id, None) is not None and notice.data.get("state") == "ok"

    def close(self, source: str) -> None:
        """Drop the line about the sensor of a closed source, because the closing has a line."""
        self._held.pop(source, None)

    def postpone(self, now_s: float) -> None:
        """Process a stall of the host at `now_s`, which is the reason for the lost sensors."""
        self._stalled_s = now_s
        for line in self._held.values():
            recovered_s = min(now_s + RECOVERY_S, line.latest_s)
            line.due_s = max(line.due_s, recovered_s)

    def due(self, now_s: float) -> list[Notice]:
        """Return the notices whose sources were not closed in time, each once."""
        found = [name for name, line in self._held.items() if now_s >= line.due_s]
        return [self._held.pop(name).notice for name in found]
