"""Log lines on sensors without data: one for each sensor and outage.

A source that is closed has a line with the reason. The line on its sensor, which comes first
because the fusion notices missing data earlier, is therefore held until the source may no longer
be closed for this silence. A source that still sends something is not closed. After a stall of
this host, which has a line of its own, the lines are held until the sensors may have recovered.
"""

from __future__ import annotations

from math import inf

from jointfit_daemon.pipeline.events import Notice, NoticeKind, NoticeLevel

STALL_S = 0.5
"""Delay of the event loop, s, above which sensors appear to have no data."""
STALL_REPEAT_S = 60.0
"""Shortest interval between two lines on stalls, s."""
RECOVERY_S = 4.0
"""Time after a stall of the event loop in which sensors recover, s: 2 s without a fault, and 2 s
to process the data that had to wait."""


class OutageLines:
    """Holds the notices on lost sensors that need no line of their own."""

    def __init__(self) -> None:
        self._held: dict[str, tuple[float, Notice]] = {}
        self._stalled_s = self._reported_s = -inf

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
            due_s = inf if wait_s is None else now_s + wait_s
            self._held[notice.id] = (max(due_s, self._stalled_s + RECOVERY_S), notice)
            return True
        # A pause in the data that ended in time is reported as a gap.
        return self._held.pop(notice.id, None) is not None and notice.data.get("state") == "ok"

    def close(self, source: str) -> None:
        """Drop the line on the sensor of a source that is closed, and so has a line."""
        self._held.pop(source, None)

    def due(self, now_s: float, delay_s: float = 0.0) -> list[Notice]:
        """Return the notices whose sources were not closed in time, each once.

        If the event loop was delayed by `delay_s` > `STALL_S`, sensors were lost for this reason:
        one notice on the gateway is returned, and theirs are postponed.
        """
        stalls = []
        if delay_s > STALL_S:
            self._stalled_s = now_s
            for name, (due_s, notice) in self._held.items():
                self._held[name] = (max(due_s, now_s + RECOVERY_S), notice)
            if now_s - self._reported_s >= STALL_REPEAT_S:
                self._reported_s, t_ns = now_s, round(now_s * 1e9)
                level, text = NoticeLevel.WARNING, _text(delay_s)
                stalls = [Notice(t_ns, NoticeKind.DEVICE, "gateway", text, level)]

        found = [name for name, (due_s, _) in self._held.items() if now_s >= due_s]
        return stalls + [self._held.pop(name)[1] for name in found]


def _text(delay_s: float) -> str:
    return (
        f"stopped or overloaded for {1000 * delay_s:.0f} ms, the data of this time are late or "
        "lost: stop other programs, or use a faster gateway"
    )
