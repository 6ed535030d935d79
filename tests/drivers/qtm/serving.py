"""A simulated QTM server that answers and sends frames."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Any

from jointfit_simulators.devices import QtmServer, QtmServerOptions, RigidBodyAsset

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

THIGH = RigidBodyAsset("Thigh", ("T1", "T2", "T3"), 1)
SHANK = RigidBodyAsset("Shank", ("S1",), 2)
POSE = ((1.0, 2.0, 3.0), (0.8, 0.0, 0.0, 0.6))
SEEN: dict[str, Any] = {"T1": (0.1, 0.2, 0.3), "T3": (1.0, -2.0, 0.5), "loose": (9.0, 9.0, 9.0)}


def made(**options: Any) -> QtmServer:
    return QtmServer(QtmServerOptions(**({"bodies": (THIGH, SHANK)} | options)))


@contextlib.asynccontextmanager
async def served(
    server: QtmServer, *, sends: bool = True, before: Callable[[], None] = lambda: None
) -> AsyncIterator[None]:
    """Answer, and send a frame every 10 ms."""

    async def push() -> None:
        while sends:
            before()
            server.push(time.monotonic_ns(), SEEN, {"Thigh": POSE, "Shank": None})
            await asyncio.sleep(0.01)

    tasks = [asyncio.create_task(server.run()), asyncio.create_task(push())]
    await server.ready.wait()
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        server.unplug()
