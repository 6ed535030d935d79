"""Minimal publisher with aiomqtt that reconnects as the documentation of aiomqtt describes.

``python -m tests.faults.aiomqtt_publisher HOST PORT TOPIC PAUSE`` publishes a number 100 times a
second. After an error it waits PAUSE seconds. It prints ``lost`` for each error.
"""

from __future__ import annotations

import asyncio
import sys

import aiomqtt

PERIOD_S = 0.01


async def publish(host: str, port: int, topic: str, pause_s: float) -> None:
    """Publish until the process is killed."""
    client, number = aiomqtt.Client(host, port), 0
    while True:
        try:
            async with client:
                while True:
                    await client.publish(topic, str(number))
                    number += 1
                    await asyncio.sleep(PERIOD_S)
        except aiomqtt.MqttError:
            print("lost", flush=True)
            await asyncio.sleep(pause_s)


if __name__ == "__main__":
    asyncio.run(publish(sys.argv[1], int(sys.argv[2]), sys.argv[3], float(sys.argv[4])))
