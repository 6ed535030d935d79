"""Detects that the daemon has less processor time or bandwidth than its outputs need."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.outputs.mqtt import LinkHealth
    from jointfit_daemon.outputs.payloads import ProcessHealth

DELAY_MS = 500.0
"""Event loop delay, 0.99 quantile of a minute, ms, above which the daemon is overloaded."""
DROPPED_SHARE = 0.2
"""Share of dropped MQTT messages in one health interval above which the daemon is overloaded."""
FEWEST = 20
"""Messages in one health interval below which the share is not evaluated."""
REPEAT_S = 300.0
"""Shortest interval between two warnings, s."""


class OverloadMonitor:
    """Compares successive health reports with the limits of this module."""

    def __init__(self) -> None:
        self._counts = (0, 0, 0)  # connections, sent and dropped messages at the last report
        self._due_s = -inf

    def warning(self, process: ProcessHealth, link: LinkHealth, now_s: float) -> str | None:
        """Return the text of a warning, or None; call once for each health report.

        An interval in which the connection to the broker was lost is not evaluated.
        """
        before, self._counts = self._counts, (link.connects, link.sent, link.dropped)
        sent, dropped = link.sent - before[1], link.dropped - before[2]
        total = sent + dropped
        lossy = total >= FEWEST and dropped > DROPPED_SHARE * total
        lossy &= link.connected and link.connects == before[0]

        delay_ms = process.loop_delay_p99_ms or 0.0
        if now_s < self._due_s or not (lossy or delay_ms > DELAY_MS):
            return None
        self._due_s = now_s + REPEAT_S
        return (
            f"overloaded: event loop delay {delay_ms:.0f} ms (limit {DELAY_MS:.0f} ms), {dropped} "
            f"of {total} MQTT messages dropped since the last health report (limit "
            f"{DROPPED_SHARE:.0%}): lower output_rate_hz, sensors_hz or chain_hz, stop other "
            "programs, or use a faster gateway or network"
        )
