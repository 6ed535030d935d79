"""Detection that the daemon has less processor time or bandwidth than its outputs need.

Invariant: each cause has one warning. If messages are dropped because the event loop was delayed,
there is no second warning.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.outputs.mqtt import LinkHealth

STALL_S = 0.5
"""Delay of the event loop above which sensors appear to send no data, s."""
STALL_REPEAT_S = 60.0
"""Shortest interval between two warnings about stalls, s."""
DROPPED_SHARE = 0.2
"""Largest tolerated share of dropped messages among the sent and dropped MQTT messages of one
health interval."""
FEWEST = 20
"""Smallest number of messages in one health interval for which the share is evaluated."""
REPEAT_S = 300.0
"""Shortest interval between two warnings about dropped messages, s."""
_LIGHTEN = "lower output_rate_hz, sensors_hz or chain_hz, "


class OverloadMonitor:
    """Compares delays of the event loop and health reports with the limits of this module."""

    def __init__(self) -> None:
        self._stalls, self._longest_s = 0, 0.0
        """Number of stalls since the last warning, and duration of the longest, s."""
        self._stalled = False  # whether a stall occurred since the last health report
        self._stall_due_s = self._due_s = -inf
        self._counts = (0, 0, 0)  # connections, sent and dropped messages at the last report

    def stall_warning(self, delay_s: float, now_s: float) -> str | None:
        """Return the warning for an event loop delayed by `delay_s`; None if no warning is due."""
        if delay_s <= STALL_S:
            return None
        self._stalled = True
        self._stalls, self._longest_s = self._stalls + 1, max(self._longest_s, delay_s)
        if now_s < self._stall_due_s:
            return None

        more = ""
        if self._stalls > 1:
            since_s = now_s - self._stall_due_s + STALL_REPEAT_S
            more = f" at most, {self._stalls} times in the last {since_s:.0f} s"
        text = (
            f"gateway: stopped or overloaded for {1000 * self._longest_s:.0f} ms{more}, the data "
            f"of this time are late or lost: stop other programs, {_LIGHTEN}or use a faster "
            "gateway"
        )
        self._stalls, self._longest_s = 0, 0.0
        self._stall_due_s = now_s + STALL_REPEAT_S
        return text

    def drop_warning(self, link: LinkHealth, now_s: float) -> str | None:
        """Return the warning about dropped messages, or None. Call it once per health report.

        An interval is not evaluated if it contains a stall or a loss of the connection to the
        broker.
        """
        stalled, self._stalled = self._stalled, False
        before, self._counts = self._counts, (link.connects, link.sent, link.dropped)
        sent, dropped = link.sent - before[1], link.dropped - before[2]
        total = sent + dropped
        lossy = total >= FEWEST and dropped > DROPPED_SHARE * total
        lossy &= link.connected and link.connects == before[0] and not stalled
        if now_s < self._due_s or not lossy:
            return None
        self._due_s = now_s + REPEAT_S
        return (
            f"mqtt: {dropped} of {total} messages dropped since the last health report (limit "
            f"{DROPPED_SHARE:.0%}), the network or the broker is too slow for them: {_LIGHTEN}or "
            "use a faster network or broker"
        )
