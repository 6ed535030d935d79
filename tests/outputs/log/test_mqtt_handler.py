"""Log lines on MQTT: a thread that logs without pause does not load the event loop."""

from __future__ import annotations

import asyncio
import logging

from jointfit_daemon.outputs.log import MqttLogHandler


async def test_a_flood_of_warnings_from_a_thread_does_not_fill_the_queue_of_the_loop() -> None:
    published: list[int] = []
    handler = MqttLogHandler(lambda *line: published.append(line[-1]))
    loop, queued = asyncio.get_running_loop(), 0
    call = loop.call_soon_threadsafe

    def count(*arguments: object) -> object:
        nonlocal queued
        queued += 1
        return call(*arguments)  # type: ignore[arg-type]

    def flood() -> None:
        for number in range(2000):
            handler.emit(logging.LogRecord("x", logging.WARNING, "", 0, f"{number}", (), None))

    loop.call_soon_threadsafe = count  # type: ignore[assignment, method-assign]
    try:
        await asyncio.to_thread(flood)
    finally:
        del loop.call_soon_threadsafe
    assert queued < 20
    await asyncio.sleep(0.3)  # one more line is permitted by now
    handler.emit(logging.LogRecord("x", logging.WARNING, "", 0, "last", (), None))
    assert published[:5] == [0] * 5
    assert sum(published) > 1950
