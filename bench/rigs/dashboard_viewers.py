"""Viewers of the dashboard: `python -m bench.rigs.dashboard_viewers PORT BASE COUNT`.

Invariant: each viewer subscribes to the topics of the page through the tunnel of the dashboard's
server, like a browser, and reads every message. The process prints the line ``ready`` when all
viewers have received poses. When its input is closed, it prints the smallest number of bytes that a
viewer has received since ``ready``, and ends.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import sys

from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed
from websockets.typing import Subprotocol

HOST = "127.0.0.1"
TOPICS = (
    "bridge/state", "bridge/info", "bridge/health", "bridge/event", "bridge/response/#",
    "calibration", "calibration/progress", "device/+/+", "pose/ui", "optical/pose",
)  # fmt: skip
"""Topics, relative to the base topic, to which the page subscribes."""


def packet(kind: int, content: bytes) -> bytes:
    """Return an MQTT packet, whose length field has one or two bytes."""
    length = len(content)
    size = bytes([length]) if length < 128 else bytes([length % 128 | 128, length // 128])
    return bytes([kind]) + size + content


def text(value: str) -> bytes:
    """Return an MQTT string, which is its length followed by UTF-8 bytes."""
    return len(value.encode()).to_bytes(2) + value.encode()


async def view(port: int, base: str, received: list[int], number: int) -> None:
    """Receive messages until cancelled; count their bytes."""
    url = f"ws://{HOST}:{port}/mqtt"
    async with connect(url, subprotocols=[Subprotocol("mqtt")], compression=None) as websocket:
        name = text(f"viewer-{number}")
        await websocket.send(packet(0x10, text("MQTT") + bytes([5, 2, 0, 0, 0]) + name))
        filters = b"".join(text(f"{base}/{topic}") + b"\0" for topic in TOPICS)
        await websocket.send(packet(0x82, bytes([0, 1, 0]) + filters))
        with contextlib.suppress(ConnectionClosed):
            async for message in websocket:
                received[number] += len(message)


async def run(port: int, base: str, count: int) -> int:
    """Run viewers until the input is closed; return the smallest number of received bytes."""
    received = [0] * count
    tasks = [asyncio.create_task(view(port, base, received, n)) for n in range(count)]
    closed = asyncio.create_task(asyncio.to_thread(sys.stdin.read))
    while min(received) < 20_000 and not closed.done():  # noqa: ASYNC110 - counted by all viewers
        await asyncio.sleep(0.05)
    print("ready", flush=True)
    before = [*received]
    await closed
    for task in tasks:
        task.cancel()
    await asyncio.wait(tasks)
    return min(now - then for now, then in zip(received, before, strict=True))


def main() -> None:
    """Run the viewers that the arguments describe."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("port", type=int)
    parser.add_argument("base")
    parser.add_argument("count", type=int)
    options = parser.parse_args()
    print(asyncio.run(run(options.port, options.base, options.count)))


if __name__ == "__main__":
    main()
