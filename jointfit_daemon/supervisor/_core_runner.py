"""Passes events and time to the core, and distributes the core's outputs to the sinks.

Invariant: events are processed one at a time in the order of arrival, and each sink receives an
event before the core processes it. An exception of the core is a bug, which propagates and ends the
daemon.
"""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Protocol

from jointfit_daemon.pipeline.events import Tick, UnixOffset
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.outputs.sink import Sink
    from jointfit_daemon.outputs.unix_clock import UnixClock
    from jointfit_daemon.pipeline.events import Event, Output
    from jointfit_daemon.pipeline.health import CoreHealth
    from jointfit_daemon.pipeline.stage_observer import StageObserver

LONGEST_TICK_INTERVAL_NS = 100_000_000
"""Longest time without an event for the core, ns."""
_SHORTEST_WAIT_NS = 1_000_000
"""Shortest wait for a deadline, ns. Without it, a deadline that stays in the past would block the
event loop."""


class CoreInterface(Protocol):
    """Interface of the core, with the methods that the supervisor uses."""

    stages: StageObserver | None
    """Observer of the processing stages of every frame; None without observer."""

    @property
    def next_deadline_ns(self) -> int | None:
        """Latest time of the next `Tick`, CLOCK_MONOTONIC ns."""

    def feed(self, event: Event) -> list[Output]:
        """Process one event and return its outputs."""

    def descriptions(self) -> Mapping[str, tuple[bytes, ...]]:
        """Return, for each open source, the chunks that a new decoder needs before all others."""

    def health(self, now_ns: int) -> CoreHealth:
        """Return counters and clock estimates."""


class CoreRunner:
    """Runs the core on the event loop.

    Parameters
    ----------
    core
        The core, which has no clock and no I/O.
    clock
        Clock that measures the UNIX time offset for the core.
    """

    def __init__(self, core: CoreInterface, clock: UnixClock) -> None:
        self.core = core
        self._sinks: list[Sink] = []
        self._fed_ns = time.monotonic_ns()
        self._loop = asyncio.get_running_loop()
        self._failed: asyncio.Future[None] = self._loop.create_future()
        self._timer: asyncio.TimerHandle | None = None
        self._timer_ns = 0
        self._unix_clock = clock
        self._unix_offset_ns: int | None = None

    def subscribe(self, sink: Sink) -> None:
        """Pass all further events and outputs to `sink`, which must not call `feed`."""
        self._sinks.append(sink)

    def unsubscribe(self, sink: Sink) -> None:
        """End the subscription of `sink`."""
        self._sinks.remove(sink)

    def feed(self, event: Event) -> None:
        """Pass one event to the sinks and the core, then the core's outputs to the sinks."""
        for sink in self._sinks:
            sink.event(event)

        self._fed_ns = time.monotonic_ns()
        for output in self.core.feed(event):
            for sink in self._sinks:
                sink.output(output)
        self._arm()

    def _arm(self) -> None:
        """Set the timer for the next tick.

        A timer that is due before the new deadline is not changed. When it fires, the deadline is
        checked again.
        """
        due_ns = self._fed_ns + LONGEST_TICK_INTERVAL_NS
        deadline_ns = self.core.next_deadline_ns
        if deadline_ns is not None and deadline_ns < due_ns:
            due_ns = max(deadline_ns, self._fed_ns + _SHORTEST_WAIT_NS)

        if self._timer is None or due_ns < self._timer_ns:
            if self._timer is not None:
                self._timer.cancel()
            self._timer_ns = due_ns
            self._timer = self._loop.call_at(due_ns / NS_PER_S, self._tick)

    def _tick(self) -> None:
        self._timer = None
        now_ns = time.monotonic_ns()
        deadline_ns = self.core.next_deadline_ns
        due = deadline_ns is not None and now_ns >= deadline_ns
        try:
            self._feed_unix_offset()
            if due or now_ns >= self._fed_ns + LONGEST_TICK_INTERVAL_NS:
                self.feed(Tick(now_ns))
            else:
                self._arm()
        except Exception as error:  # noqa: BLE001 - a timer callback would only log it
            if not self._failed.done():
                self._failed.set_exception(error)

    def _feed_unix_offset(self) -> None:
        """Pass the offset of UNIX time to the core, at the start and after each change."""
        offset_ns = self._unix_clock.offset_ns()
        if offset_ns != self._unix_offset_ns:
            self._unix_offset_ns = offset_ns
            self.feed(UnixOffset(time.monotonic_ns(), offset_ns))

    async def run(self) -> None:
        """Feed ticks to the core until cancelled, and raise exceptions of the core."""
        self._feed_unix_offset()
        self._arm()
        try:
            await self._failed
        finally:
            if self._timer is not None:
                self._timer.cancel()
