"""Serial line based on a pty: all accepted bytes arrive."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING

from jointfit_simulators.wires import PtyLine

if TYPE_CHECKING:
    from pathlib import Path

MESSAGE = bytes(range(256)) * 4


async def test_last_message_arrives_complete_when_the_host_reads_again(tmp_path: Path) -> None:
    line = PtyLine(tmp_path / "line")
    serving = asyncio.create_task(line.serve(lambda _: None))
    await asyncio.sleep(0)
    host = os.open(tmp_path / "line", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        accepted = 0
        while line.write(MESSAGE):
            accepted += len(MESSAGE)
        arrived = 0
        async with asyncio.timeout(10):
            while arrived < accepted:
                await asyncio.sleep(0.001)
                try:
                    arrived += len(os.read(host, 65536))
                except BlockingIOError:
                    continue
        assert arrived == accepted
    finally:
        os.close(host)
        serving.cancel()
        await asyncio.wait([serving])
        line.unplug()
