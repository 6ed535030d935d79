"""Helpers that run motion-capture servers and drivers, for tests of several families."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

from jointfit_daemon.model import DeviceEvent, MocapFrame

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from jointfit_daemon.driver import Driver
    from jointfit_daemon.model import Chunk, Decoded


@contextlib.asynccontextmanager
async def answering(server: Any, push: Callable[[], object] | None) -> AsyncIterator[None]:
    """Run a server, and unplug it at the end; call `push`, if given, every 10 ms."""

    async def send() -> None:
        while push is not None:
            push()
            await asyncio.sleep(0.01)

    tasks = [asyncio.create_task(server.run()), asyncio.create_task(send())]
    if hasattr(server, "ready"):
        await server.ready.wait()
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        server.unplug()


class MocapRun:
    """A running driver, and the output of its decoder."""

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self.decoder: Any = driver.decoder()
        self.items: list[Decoded] = []

    def _emit(self, chunk: Chunk) -> None:
        self.items += self.decoder.feed(chunk)

    @property
    def frames(self) -> list[MocapFrame]:
        return [item for item in self.items if isinstance(item, MocapFrame)]

    def texts(self) -> list[str]:
        return [item.text for item in self.items if isinstance(item, DeviceEvent)]

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(10):
            while not condition():
                assert not self.task.done(), self.task.exception()
                await asyncio.sleep(0.01)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        self.task = asyncio.create_task(self.driver.run(self._emit))
        try:
            yield
        finally:
            self.task.cancel()
            await asyncio.wait([self.task])
