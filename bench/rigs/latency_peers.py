"""Senders of the time at 100 Hz: `python -m bench.rigs.latency_peers (mqtt PORT TOPIC | lsl NAME)`.

``mqtt`` is a minimal publisher with aiomqtt; ``lsl`` is an outlet of the Lab Streaming Layer. Each
sends the current time and as many other bytes as a pose has. Neither receives or computes anything.
"""

from __future__ import annotations

import asyncio
import sys
import time
from typing import TYPE_CHECKING, Any

import orjson
from aiomqtt import Client, ProtocolVersion

if TYPE_CHECKING:
    from collections.abc import Callable

RATE_HZ = 100.0
POSE_BYTES = 1200
"""Size of the payload of a pose with two segments and three joints, bytes."""
CHANNELS = POSE_BYTES // 8


async def send_forever(send: Callable[[int], Any]) -> None:
    """Call `send` with the current UNIX time in ns at a constant rate."""
    due_s = time.monotonic()
    while True:
        due_s += 1.0 / RATE_HZ
        await asyncio.sleep(due_s - time.monotonic())
        if (sending := send(time.time_ns())) is not None:
            await sending


async def publish(port: int, topic: str) -> None:
    """Publish the time in a JSON object at QoS 0."""
    rest = "x" * POSE_BYTES
    async with Client("127.0.0.1", port, protocol=ProtocolVersion.V5) as client:
        await send_forever(
            lambda now_ns: client.publish(topic, orjson.dumps({"t_ns": now_ns, "rest": rest}))
        )


async def stream(name: str) -> None:
    """Send the time as the first of `CHANNELS` numbers of an outlet."""
    import pylsl  # noqa: PLC0415 - the other sender does not need it

    info = pylsl.StreamInfo(name, "test", CHANNELS, RATE_HZ, "double64", name)
    outlet = pylsl.StreamOutlet(info)
    numbers = [0.0] * CHANNELS

    def send(now_ns: int) -> None:
        numbers[0] = float(now_ns)
        outlet.push_sample(numbers)

    await send_forever(send)


if __name__ == "__main__":
    if sys.argv[1] == "mqtt":
        asyncio.run(publish(int(sys.argv[2]), sys.argv[3]))
    else:
        asyncio.run(stream(sys.argv[2]))
