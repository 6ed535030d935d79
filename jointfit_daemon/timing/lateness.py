"""Samples that stay late: the device's clock stood still, or was set back, and nothing else tells.

Law: pure; one small state a clock. A late sample is no news, and late ones for a while are a busy
wire; only when none was on time for two seconds the clock itself must have changed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.timing.clock_news import too_late

if TYPE_CHECKING:
    from jointfit_daemon.timing.clock_news import ClockNews

LATE_NS = 50_000_000
LATE_FOR_NS = 2_000_000_000
LATE_SIGMAS = 20.0


class Lateness:
    """Since when every sample has been late."""

    __slots__ = ("_since",)

    def __init__(self) -> None:
        self._since: int | None = None

    def on_time(self) -> None:
        """Take a sample that was not late by ``LATE_NS``."""
        self._since = None

    def feed(self, excess_ns: float, sigma_ns: float, arrival_ns: int) -> ClockNews | None:
        """Take how far above a settled envelope a sample is; return what follows, if anything."""
        if excess_ns < LATE_SIGMAS * sigma_ns:
            self._since = None
            return None
        if self._since is None:
            self._since = arrival_ns
        late_for = arrival_ns - self._since
        return too_late(excess_ns, LATE_FOR_NS / 1e9) if late_for > LATE_FOR_NS else None
