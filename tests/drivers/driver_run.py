"""Helpers that run drivers with simulated devices, for tests of several drivers."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

from jointfit_daemon.model import Chunk, ImuSample
from jointfit_drivers.xcdi import XcdiIdSettings, XcdiImu, XcdiSettings
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.wires import PtyLine

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from jointfit_daemon.driver import CanBusSettings, Driver

IDENTITY = (1.0, 0.0, 0.0, 0.0)


class DriverRun:
    """A running driver, and the decoded output of its chunks."""

    def __init__(self, driver: Driver) -> None:
        self.decoder: Any = driver.decoder()
        self.chunks: list[Chunk] = []
        self.events: list[Any] = []
        self.task = asyncio.create_task(driver.run(self._emit))

    def _emit(self, chunk: Chunk) -> None:
        self.chunks.append(chunk)
        self.events += self.decoder.feed(chunk)

    @property
    def samples(self) -> list[ImuSample]:
        return [event for event in self.events if isinstance(event, ImuSample)]

    async def wait_for(self, count: int) -> None:
        """Wait for `count` samples; raise the error that ended the driver, if any."""
        async with asyncio.timeout(5):
            while len(self.samples) < count:
                if self.task.done():
                    self.task.result()
                await asyncio.sleep(0.005)

    async def cancel(self) -> None:
        self.task.cancel()
        await asyncio.wait({self.task})


@contextlib.asynccontextmanager
async def serving(*devices: Any, feeding: bool = False) -> AsyncIterator[None]:
    """Run devices, and unplug them at the end; with `feeding`, each sends every 10 ms."""

    async def feed(device: Any) -> None:
        number = 0
        while True:
            device.push(number * 10_000_000, orientation(number))
            number += 1
            await asyncio.sleep(0.01)

    tasks = [asyncio.create_task(device.run()) for device in devices]
    if feeding:
        tasks += [asyncio.create_task(feed(device)) for device in devices]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        for device in devices:
            device.unplug()
        for task in tasks:
            assert task.cancelled()


def xcdi_driver(
    name: str, bus: CanBusSettings, base: int = 0, *, silence_s: float = 2.0
) -> XcdiImu:
    """Return the driver of a sensor whose identifiers are increased by `base`."""
    ids = XcdiIdSettings(sample_time=base + 5, group_counter=base + 6, quaternion=base + 0x21)
    return XcdiImu(
        XcdiSettings(id=name, segment="shank", driver="xcdi", can=bus, ids=ids, silence_s=silence_s)
    )


class TextDevice:
    """A device of another kind, which answers every request with a line of text, like a modem."""

    def __init__(self, link: Path) -> None:
        self._line = PtyLine(link)
        self.unplug, self.plug = self._line.unplug, self._line.plug

    async def run(self) -> None:
        await self._line.serve(self._answer)

    def _answer(self, _: bytes) -> None:
        self._line.write(b"\r\nERROR\r\n")
