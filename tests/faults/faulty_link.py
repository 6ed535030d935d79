"""A TCP proxy between the daemon and the broker, which is slow or simulates lost segments.

The proxy is used because not every kernel has netem, the network emulator of Linux. TCP sends a
lost segment again after a pause, and the proxy makes this pause. The connections of other clients
have no fault.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tests.broker_fixture import chosen_broker

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.faults.gateway import Gateway

_CHUNK = 4096
"""Bytes that are passed on at once."""
_BUFFER = 16_384
"""Receive buffer of the proxy, bytes. If it is full, the buffers of the daemon fill."""
_TIMEOUT_S = 0.2
"""Shortest time after which Linux sends a lost segment again, s; doubled at each repetition."""
_WILL = b"bridge/state"
"""Topic of the will, which only the first packet of the daemon contains."""


@dataclass
class FaultyLink:
    """Faults of the connection between the daemon and the broker."""

    broker_port: int
    bytes_per_s: float | None = None
    """Rate from the daemon to the broker; None: unlimited."""
    loss: float = 0.0
    """Share of segments that are lost, in both directions."""
    writers: list[asyncio.StreamWriter] = field(default_factory=list)
    _random: random.Random = field(default_factory=lambda: random.Random(5))

    async def accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Connect a client to the broker until one of them closes."""
        self.writers.append(writer)
        with contextlib.suppress(OSError):
            first = await reader.read(_CHUNK)
            there, back = await asyncio.open_connection("127.0.0.1", self.broker_port)
            self.writers.append(back)
            back.write(first)
            faulty = _WILL in first
            ways = (self._pass_on(reader, back, faulty), self._pass_on(there, writer, faulty))
            tasks = [asyncio.create_task(way) for way in ways]
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in tasks:
                task.cancel()
            back.close()
        writer.close()

    async def _pass_on(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, faulty: bool
    ) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(_CHUNK):
                pause_s = _TIMEOUT_S
                while faulty and self._random.random() < self.loss:
                    await asyncio.sleep(pause_s)
                    pause_s *= 2
                if faulty and self.bytes_per_s is not None:
                    await asyncio.sleep(len(data) / self.bytes_per_s)
                writer.write(data)
                await writer.drain()


@contextlib.asynccontextmanager
async def faulty_link(gateway: Gateway) -> AsyncIterator[FaultyLink]:
    """Yield a proxy without a fault, which replaces the broker until the end of the block."""
    behind = chosen_broker()(gateway.folder)
    gateway.broker.stop()
    behind.start()
    link = FaultyLink(behind.port)
    server = await asyncio.start_server(
        link.accept, "127.0.0.1", gateway.broker.port, reuse_address=True, limit=_BUFFER
    )
    try:
        await gateway.used(*gateway.names)
        yield link
    finally:
        server.close()
        for writer in link.writers:
            writer.transport.abort()
        behind.stop()
        gateway.broker.start()
        await gateway.used(*gateway.names)
