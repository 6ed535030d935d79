"""Log lines on sensors without data: one for each sensor and outage.

A source that is closed has a line with the reason. The line on its sensor, which comes first
because the fusion notices missing data earlier, is therefore held until the source may no longer
be closed for this silence. A source that still sends something is not closed.
"""

from __future__ import annotations

from math import inf

from jointfit_daemon.pipeline.events import Notice, NoticeKind


class OutageLines:
    """Holds the notices on lost sensors that need no line of their own."""

    def __init__(self) -> None:
        self._held: dict[str, tuple[float, Notice]] = {}

    def holds(self, notice: Notice, now_s: float, wait_s: float | None) -> bool:
        """Return whether `notice` gets no line now.

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
            self._held[notice.id] = (inf if wait_s is None else now_s + wait_s, notice)
            return True
        # A pause in the data that ended in time is reported as a gap.
        return self._held.pop(notice.id, None) is not None and notice.data.get("state") == "ok"

    def close(self, source: str) -> None:
        """Drop the line on the sensor of a source that is closed, and so has a line."""
        self._held.pop(source, None)

    def due(self, now_s: float) -> list[Notice]:
        """Return the notices whose sources were not closed in time, each once."""
        found = [name for name, (due_s, _) in self._held.items() if now_s >= due_s]
        return [self._held.pop(name)[1] for name in found]
