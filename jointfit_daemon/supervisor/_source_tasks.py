"""One task per source, which retries a lost device and pauses a misconfigured one.

Invariant: a source is opened in the core with its first chunk and closed when its driver ends. No
source stops permanently. A misconfigured source is retried when another device appears on its port,
at a reload, and after one minute at the latest. An exception of a driver that reports neither a
lost nor a misconfigured device is a bug and ends the daemon.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import time
from typing import TYPE_CHECKING, Literal

from jointfit_daemon.driver import (
    DeviceAbsentError,
    DeviceLostError,
    DeviceMisconfiguredError,
    device_path,
)
from jointfit_daemon.pipeline.events import ChunkArrived, SourceClosed, SourceOpened

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from jointfit_daemon.config import Source
    from jointfit_daemon.model import Chunk
    from jointfit_daemon.pipeline.events import Event

FIRST_RETRY_S = 0.1
"""Wait before the first retry, s. A device that was plugged in again is available at once."""
LAST_RETRY_S = 1.0
"""Longest wait before a retry, s. Operation resumes within two seconds after a device is plugged
in."""
SERVER_RETRY_S = 0.25
"""Longest wait before a retry of a source without a port, s. No device file shows that the server
is available again, and an attempt costs only a few datagrams."""
WORKED_S = 1.0
"""Time with data after which the waits and pauses of a source return to their first values, s."""
PAUSE_S = 60.0
"""Longest pause of a misconfigured source, s. A device may be reconfigured without being
unplugged."""
PLUGGED_S = 0.05
"""Interval between checks whether an absent port exists again, before the next retry is due, s."""
SERVER_PAUSE_S = 5.0
"""First pause of a misconfigured source without a port, s. No device file shows that the server's
configuration was changed. Each further pause is twice as long, up to `PAUSE_S`, until the source
has sent data."""
CHECK_S = 0.5
"""Interval between checks of the port of a paused source, s. Each check is one call of stat(2)."""


class _SourceReporter:
    """Reports the state of one source to the core: open at its first chunk, closed at its end."""

    def __init__(self, source: str, deliver: Callable[[Event], None], known: asyncio.Event) -> None:
        self._source, self._deliver, self._known = source, deliver, known
        self._open = self._absent = False
        self._opened_s = 0.0
        self._reported = ""

    @property
    def worked(self) -> bool:
        """Whether the source has sent data for `WORKED_S`."""
        return self._open and asyncio.get_running_loop().time() - self._opened_s > WORKED_S

    def emit(self, chunk: Chunk) -> None:
        """Pass a chunk to the core."""
        if not self._open:
            self._open, self._absent, self._reported = True, False, ""
            self._opened_s = asyncio.get_running_loop().time()
            self._known.set()
            self._deliver(SourceOpened(chunk.t_ns, self._source))
        self._deliver(ChunkArrived(self._source, chunk))

    def report_end(
        self, reason: Literal["lost", "misconfigured"], text: str, *, absent: bool = False
    ) -> None:
        """Report the end of the source. Successive attempts with the same fault are reported once.

        After the first report of an `absent` device, further failed attempts are not reported.
        """
        self._known.set()
        repeated = text == self._reported or (absent and self._absent)
        if self._open or not repeated:
            self._deliver(SourceClosed(time.monotonic_ns(), self._source, reason, text))
            self._reported = text
        self._open, self._absent = False, absent

    def report_removal(self) -> None:
        """Report the removal of the source if it was open."""
        if self._open:
            self._deliver(SourceClosed(time.monotonic_ns(), self._source, "removed", "stopped"))
            self._open = False


class _RunningSource:
    """State of one source, including its task.

    Attributes
    ----------
    known
        Event that is set when the source has sent a chunk, or its driver has ended.
    paused
        Whether the source is misconfigured and waits for another device.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.known = asyncio.Event()
        self.paused = False
        self.task: asyncio.Task[None] | None = None


async def run_source(
    source: Source, deliver: Callable[[Event], None], state: _RunningSource | None = None
) -> None:
    """Run one source until cancelled.

    Parameters
    ----------
    source
        Source to run.
    deliver
        Function that feeds one event to the core.
    state
        Object that receives the state of the source.
    """
    state = state or _RunningSource(source)
    reporter = _SourceReporter(source.id, deliver, state.known)
    # All attempts share one driver object, because it may store findings of failed attempts.
    driver = source.driver_class(source.settings)
    path = device_path(source.settings)
    longest_s, first_pause_s = LAST_RETRY_S, PAUSE_S
    retried = f"trying again every {PAUSE_S:g} s, and when another device is on the port"
    if path is None:
        longest_s, first_pause_s = SERVER_RETRY_S, SERVER_PAUSE_S
        retried = f"retrying within {PAUSE_S:g} s"

    delay_s, pause_s = FIRST_RETRY_S, first_pause_s
    while True:
        device, misconfigured, absent = _device_identity(path), False, False
        try:
            await driver.run(reporter.emit)
            text = "its driver ended by itself: report this to the author of the driver; retrying"
        except DeviceLostError as lost:
            absent, text = isinstance(lost, DeviceAbsentError), str(lost)
        except DeviceMisconfiguredError as wrong:
            misconfigured, text = True, f"{wrong} ({retried})"
        except asyncio.CancelledError:
            reporter.report_removal()
            raise

        if reporter.worked:
            delay_s, pause_s = FIRST_RETRY_S, first_pause_s
        # The core logs the fault. The text does not contain the duration of the pause, so that a
        # repeated fault has the same text.
        reporter.report_end("misconfigured" if misconfigured else "lost", text, absent=absent)
        if misconfigured:
            state.paused = True
            await _wait_for_change(path, device, pause_s)
            state.paused, delay_s = False, FIRST_RETRY_S
            pause_s = min(2 * pause_s, PAUSE_S)

        # A random wait (full jitter) prevents sources that are lost together from retrying
        # together.
        await _wait_for_retry(path, random.uniform(0, delay_s))  # noqa: S311 - not security-relevant
        delay_s = min(2 * delay_s, longest_s)


async def _wait_for_retry(path: str | None, delay_s: float) -> None:
    """Wait for `delay_s`. If no device exists at `path`, end the wait when a device appears."""
    absent = path is not None and _device_identity(path) is None
    loop = asyncio.get_running_loop()
    until_s = loop.time() + delay_s
    while (left_s := until_s - loop.time()) > 0.0:
        await asyncio.sleep(min(left_s, PLUGGED_S) if absent else left_s)
        if absent and _device_identity(path) is not None:
            return


async def _wait_for_change(path: str | None, device: object, pause_s: float) -> None:
    """Wait until the device at `path` is no longer `device`; at most `pause_s`."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(pause_s):
            while _device_identity(path) == device:  # noqa: ASYNC110 - a file system has no event
                await asyncio.sleep(CHECK_S)


def _device_identity(path: str | None) -> object:
    """Return a value that differs between devices that are plugged in one after another.

    The value is None if there is no device. A name without a slash is a network interface
    (``can0``).
    """
    if path is None:
        return None
    try:
        found = os.stat(path if "/" in path else f"/sys/class/net/{path}")  # noqa: PTH116 - any text
    except (OSError, ValueError):
        return None
    return found.st_dev, found.st_ino, found.st_rdev, found.st_ctime_ns


class SourceTasks:
    """Tasks of the sources of the current rig.

    Parameters
    ----------
    tasks : asyncio.TaskGroup
        Root task group, which a bug in a driver ends.
    deliver : callable
        Function that feeds one event to the core.
    """

    def __init__(self, tasks: asyncio.TaskGroup, deliver: Callable[[Event], None]) -> None:
        self._tasks, self._deliver = tasks, deliver
        self._running: dict[str, _RunningSource] = {}

    async def retire(self, sources: Iterable[Source]) -> None:
        """Stop the sources that are not among `sources`. Unchanged sources continue.

        Paused sources are stopped as well, because their fault may have been corrected outside
        rig.toml.
        """
        wanted = {source.id: source for source in sources}
        removed = [
            self._running.pop(name)
            for name, each in list(self._running.items())
            if wanted.get(name) != each.source or each.paused
        ]
        await stop(each.task for each in removed if each.task is not None)

    async def apply(self, sources: Iterable[Source]) -> None:
        """Start and stop sources so that exactly `sources` run."""
        wanted = {source.id: source for source in sources}
        await self.retire(wanted.values())
        for name, source in wanted.items():
            if name not in self._running:
                self._run(name, source)

    def _run(self, name: str, source: Source) -> None:
        state = self._running[name] = _RunningSource(source)
        state.task = self._tasks.create_task(
            run_source(source, self._deliver, state), name=f"source {name}"
        )

    async def restart(self, name: str) -> None:
        """Close the port of a running source, and open it again with a new driver.

        Raises
        ------
        KeyError
            No source with this name is running.
        """
        removed = self._running.pop(name)
        if removed.task is not None:
            await stop([removed.task])
        self._run(name, removed.source)

    async def wait_until_known(self, within_s: float) -> None:
        """Wait until every source has sent a chunk or its driver ended; at most `within_s`."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                for each in list(self._running.values()):
                    await each.known.wait()

    async def stop(self) -> None:
        """Stop all sources and wait until their ports are closed."""
        removed, self._running = list(self._running.values()), {}
        await stop(each.task for each in removed if each.task is not None)


async def stop(tasks: Iterable[asyncio.Task[None]]) -> None:
    """Cancel tasks and wait until they end. Exceptions propagate to the task group of the tasks."""
    ending = list(tasks)
    for task in ending:
        task.cancel()
    if ending:
        await asyncio.wait(ending)
    for task in ending:
        with contextlib.suppress(asyncio.CancelledError):
            task.exception()
