"""One task a source: retry what may heal, retire what cannot, let bugs through.

Law: a source is opened in the core when its first bytes arrive and closed when its driver ends.
Whatever else a driver raises is a bug: it ends the daemon with its traceback.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
import time
from typing import TYPE_CHECKING, Literal

from jointfit_daemon.driver import DeviceLost, DeviceMisconfigured
from jointfit_daemon.outputs.journal import about
from jointfit_daemon.pipeline.events import ChunkArrived, SourceClosed, SourceOpened

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from jointfit_daemon.config import Source
    from jointfit_daemon.model import Chunk
    from jointfit_daemon.pipeline.events import Event

log = logging.getLogger(__name__)

FIRST_RETRY_S = 0.1  # a re-plugged port is often there again within a blink
LAST_RETRY_S = 1.0  # the promise is to resume within two seconds of a re-plug
HEALTHY_S = 5.0  # after this long a loss is a new one, and is tried again at once


class _Life:
    """Tells the core about one source: opened with its first bytes, closed once."""

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


async def keep_running(
    source: Source, deliver: Callable[[Event], None], known: asyncio.Event | None = None
) -> None:
    """Run one source for ever, or until its settings prove wrong: only a reload tries again.

    Parameters
    ----------
    source
        What to run.
    deliver
        Feeds one event to the core.
    known
        Set once the source has sent something or was found absent.
    """
    life = _Life(source.id, deliver, known or asyncio.Event())
    loop = asyncio.get_running_loop()
    delay = FIRST_RETRY_S
    while True:
        began = loop.time()
        try:
            await source.driver_class(source.settings).run(life.emit)
            life.closed("lost", "its driver ended by itself")
        except DeviceLost as lost:
            if loop.time() - began > HEALTHY_S:
                delay = FIRST_RETRY_S
            life.closed("lost", str(lost))  # the core tells it, on the log too
        except DeviceMisconfigured as wrong:
            life.closed("misconfigured", str(wrong))
            log.error(  # noqa: TRY400 - it says enough
                "%s: stopped until the next reload: %s",
                source.id,
                wrong,
                extra=about("device", source.id),
            )
            return
        except asyncio.CancelledError:
            life.removed()
            raise
        await asyncio.sleep(random.uniform(0, delay))  # noqa: S311 - full jitter: no retry in step
        delay = min(2 * delay, LAST_RETRY_S)


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
        self._running: dict[str, tuple[Source, asyncio.Task[None]]] = {}
        self._known: dict[str, asyncio.Event] = {}

    async def retire(self, sources: Iterable[Source]) -> None:
        """Stop those that are not among these; one whose settings are the same keeps its port.

        One that stopped by itself is forgotten: what was wrong may be right now, outside rig.toml.
        """
        wanted = {source.id: source for source in sources}
        gone = [
            self._running.pop(name)[1]
            for name, (source, task) in list(self._running.items())
            if wanted.get(name) != source or task.done()
        ]
        await stop(gone)

    async def apply(self, sources: Iterable[Source]) -> None:
        """Run exactly these."""
        wanted = {source.id: source for source in sources}
        await self.retire(wanted.values())
        for name, source in wanted.items():
            if name not in self._running:
                known = self._known[name] = asyncio.Event()
                task = self._tasks.create_task(
                    keep_running(source, self._deliver, known), name=f"source {name}"
                )
                self._running[name] = (source, task)

    async def known(self, within_s: float) -> None:
        """Wait until every source has sent something or was found absent.

        One that has done neither within `within_s` is taken for absent: it is silent.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                for known in [self._known[name] for name in self._running]:
                    await known.wait()

    async def stop(self) -> None:
        """Stop all sources and wait until their ports are closed."""
        gone, self._running = [task for _, task in self._running.values()], {}
        await stop(gone)


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
