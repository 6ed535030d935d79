"""One task a source: retry what may heal, pause what needs another device, let bugs through.

Invariant: a source is opened in the core when its first bytes arrive and closed when its driver
ends. No source stops for good: one that is misconfigured pauses until another device is on its
port, for a minute at most, or until a reload. Whatever else a driver raises is a bug: it ends the
daemon with its traceback.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import time
from typing import TYPE_CHECKING, Literal

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError, device_path
from jointfit_daemon.pipeline.events import ChunkArrived, SourceClosed, SourceOpened

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from jointfit_daemon.config import Source
    from jointfit_daemon.model import Chunk
    from jointfit_daemon.pipeline.events import Event

FIRST_RETRY_S = 0.1  # a re-plugged port is often there again within a blink
LAST_RETRY_S = 1.0  # the promise is to resume within two seconds of a re-plug
HEALTHY_S = 5.0  # after this long a loss is a new one, and is tried again at once
PAUSE_S = 60.0  # a device may be put right without being unplugged
LOOK_S = 0.5  # between two looks at the port of a source that pauses; one stat(2) each


class _Life:
    """Reports one source to the core: opened with its first bytes, closed once."""

    def __init__(self, source: str, deliver: Callable[[Event], None], known: asyncio.Event) -> None:
        self._source, self._deliver, self._known = source, deliver, known
        self._open = False
        self._said = ""

    def emit(self, chunk: Chunk) -> None:
        """Hand a chunk to the core."""
        if not self._open:
            self._open, self._said = True, ""
            self._known.set()
            self._deliver(SourceOpened(chunk.t_ns, self._source))
        self._deliver(ChunkArrived(self._source, chunk))

    def closed(self, reason: Literal["lost", "misconfigured"], text: str) -> None:
        """Tell the end of the source, unless it never began and the same was said before."""
        self._known.set()
        if self._open or text != self._said:
            self._deliver(SourceClosed(time.monotonic_ns(), self._source, reason, text))
        self._open, self._said = False, text

    def removed(self) -> None:
        """Tell the end of a source that nobody wants any more; one that never began just goes."""
        if self._open:
            self._deliver(SourceClosed(time.monotonic_ns(), self._source, "removed", "stopped"))
            self._open = False


class _Task:
    """One running source.

    Attributes
    ----------
    known
        Set once the source has sent something or was found absent.
    paused
        Whether it waits for another device.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.known = asyncio.Event()
        self.paused = False
        self.task: asyncio.Task[None] | None = None


async def run_source(
    source: Source, deliver: Callable[[Event], None], state: _Task | None = None
) -> None:
    """Run one source for ever.

    Parameters
    ----------
    source
        What to run.
    deliver
        Feeds one event to the core.
    state
        Where to report how it runs.
    """
    state = state or _Task(source)
    life = _Life(source.id, deliver, state.known)
    driver = source.driver_class(source.settings)  # one: it may learn from attempts that failed
    path = device_path(source.settings)
    loop = asyncio.get_running_loop()
    delay = FIRST_RETRY_S
    while True:
        began, device = loop.time(), _identity(path)
        try:
            await driver.run(life.emit)
            life.closed("lost", "its driver ended by itself")
        except DeviceLostError as lost:
            if loop.time() - began > HEALTHY_S:
                delay = FIRST_RETRY_S
            life.closed("lost", str(lost))  # the core reports it, on the log too
        except DeviceMisconfiguredError as wrong:
            again = f"tried again with another device on the port, or every {PAUSE_S:g} s"
            life.closed("misconfigured", f"{wrong} ({again})")
            state.paused = True
            await _until_changed(path, device)
            state.paused, delay = False, FIRST_RETRY_S
        except asyncio.CancelledError:
            life.removed()
            raise
        await asyncio.sleep(random.uniform(0, delay))  # noqa: S311 - full jitter: no retry in step
        delay = min(2 * delay, LAST_RETRY_S)


async def _until_changed(path: str | None, device: object) -> None:
    """Wait until what is at `path` is no longer `device`; ``PAUSE_S`` at most."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(PAUSE_S):
            while _identity(path) == device:  # noqa: ASYNC110 - a file system sets no event
                await asyncio.sleep(LOOK_S)


def _identity(path: str | None) -> object:
    """Return what differs between two devices that are plugged in one after the other.

    None where there is no device. A name without folder is that of a network interface (``can0``).
    """
    if path is None:
        return None
    try:
        found = os.stat(path if "/" in path else f"/sys/class/net/{path}")  # noqa: PTH116 - any text
    except (OSError, ValueError):
        return None
    return found.st_dev, found.st_ino, found.st_rdev, found.st_ctime_ns


class SourceTasks:
    """The running sources of the rig in force.

    Parameters
    ----------
    tasks : asyncio.TaskGroup
        The root group: a bug in a driver ends it.
    deliver : callable
        Feeds one event to the core.
    """

    def __init__(self, tasks: asyncio.TaskGroup, deliver: Callable[[Event], None]) -> None:
        self._tasks, self._deliver = tasks, deliver
        self._running: dict[str, _Task] = {}

    async def retire(self, sources: Iterable[Source]) -> None:
        """Stop those that are not among these; one whose settings are the same keeps its port.

        One that pauses is stopped, too: what was wrong may be right now, outside rig.toml.
        """
        wanted = {source.id: source for source in sources}
        gone = [
            self._running.pop(name)
            for name, each in list(self._running.items())
            if wanted.get(name) != each.source or each.paused
        ]
        await stop(each.task for each in gone if each.task is not None)

    async def apply(self, sources: Iterable[Source]) -> None:
        """Run exactly these."""
        wanted = {source.id: source for source in sources}
        await self.retire(wanted.values())
        for name, source in wanted.items():
            if name not in self._running:
                state = self._running[name] = _Task(source)
                state.task = self._tasks.create_task(
                    run_source(source, self._deliver, state), name=f"source {name}"
                )

    async def known(self, within_s: float) -> None:
        """Wait until every source has sent something or was found absent.

        One that has done neither within `within_s` is taken for absent: it is silent.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                for each in list(self._running.values()):
                    await each.known.wait()

    async def stop(self) -> None:
        """Stop all sources and wait until their ports are closed."""
        gone, self._running = list(self._running.values()), {}
        await stop(each.task for each in gone if each.task is not None)


async def stop(tasks: Iterable[asyncio.Task[None]]) -> None:
    """Cancel tasks and wait for their end; their failures reach the group they belong to."""
    ending = list(tasks)
    for task in ending:
        task.cancel()
    if ending:
        await asyncio.wait(ending)
    for task in ending:
        with contextlib.suppress(asyncio.CancelledError):
            task.exception()
