"""Moves events into the core and its outputs out, and time with them.

Law: synchronous; one event at a time, in order of arrival; the event log sees each before the core
does. Whatever the core raises is a bug and ends the daemon, wherever the event came from.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Protocol

from jointfit_daemon.model import LimbState
from jointfit_daemon.outputs.unix_clock import UnixClock
from jointfit_daemon.pipeline.events import Tick, UnixOffset

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.outputs.recording import EventLogWriter
    from jointfit_daemon.pipeline.events import Event, Output

LONGEST_TICK_INTERVAL_NS = 100_000_000
"""The core hears of time at least this often."""
_LEAST_NS = 1_000_000  # a deadline that is past and stays past must not spin
_NS_PER_S = 1e9


class CoreInterface(Protocol):
    """What the shell needs of the core."""

    @property
    def next_deadline_ns(self) -> int | None:
        """When a Tick is due at the latest."""

    def feed(self, event: Event) -> list[Output]:
        """Take one event and return what it brings about."""

    def health(self, now_ns: int) -> dict[str, object]:
        """Return counters and clocks."""


class CoreRunner:
    """Feeds the core.

    Parameters
    ----------
    core
        The pure core.
    dispatch
        Takes every output, synchronously; must not feed events itself.
    """

    def __init__(self, core: CoreInterface, dispatch: Callable[[Output], None]) -> None:
        self.core = core
        self.log: EventLogWriter | None = None
        self.states = 0
        """Limb states that came out."""
        self._fed_ns = time.monotonic_ns()
        self._dispatch = dispatch
        self._loop = asyncio.get_running_loop()
        self._failed: asyncio.Future[None] = self._loop.create_future()
        self._timer: asyncio.TimerHandle | None = None
        self._timer_ns = 0
        self._unix_clock = UnixClock()

    def feed(self, event: Event) -> None:
        """Give one event to the core and hand out what it says."""
        log = self.log
        if log is not None:
            log.event(event)
        self._fed_ns = time.monotonic_ns()
        for output in self.core.feed(event):
            if isinstance(output, LimbState):
                self.states += 1
                if log is not None:
                    log.state(output)
            self._dispatch(output)
        self._arm()

    def _arm(self) -> None:
        """Set the timer, if it must ring earlier than it will; if later, it looks again then."""
        due_ns = self._fed_ns + LONGEST_TICK_INTERVAL_NS
        deadline_ns = self.core.next_deadline_ns
        if deadline_ns is not None and deadline_ns < due_ns:
            due_ns = max(deadline_ns, self._fed_ns + _LEAST_NS)
        if self._timer is None or due_ns < self._timer_ns:
            if self._timer is not None:
                self._timer.cancel()
            self._timer_ns = due_ns
            self._timer = self._loop.call_at(due_ns / _NS_PER_S, self._ring)

    def _ring(self) -> None:
        self._timer = None
        now_ns = time.monotonic_ns()
        deadline_ns = self.core.next_deadline_ns
        due = deadline_ns is not None and now_ns >= deadline_ns
        try:
            self._tell_unix_time()
            if due or now_ns >= self._fed_ns + LONGEST_TICK_INTERVAL_NS:
                self.feed(Tick(now_ns))
            else:
                self._arm()
        except Exception as error:  # noqa: BLE001 - from here it would only reach a log
            if not self._failed.done():
                self._failed.set_exception(error)

    def _tell_unix_time(self) -> None:
        """Tell the core what UNIX time is, at first and whenever it was set."""
        offset_ns = self._unix_clock.news_ns()
        if offset_ns is not None:
            self.feed(UnixOffset(time.monotonic_ns(), offset_ns))

    async def run(self) -> None:
        """Keep time until cancelled; raise what the core raised on a Tick."""
        self._tell_unix_time()
        self._arm()
        try:
            await self._failed
        finally:
            if self._timer is not None:
                self._timer.cancel()
