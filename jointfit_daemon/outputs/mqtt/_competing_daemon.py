"""Another daemon with the same client id: detected by short connections, watched until it ends.

A broker ends the older of two connections with one client id. So two daemons with one base take the
connection from each other, for ever. The daemon whose connection was the shorter gives way: it
connects under another id, which disturbs nobody, and waits until the other is gone.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from jointfit_daemon.outputs.mqtt._connection import MqttConnection

if TYPE_CHECKING:
    from jointfit_daemon.config import MqttSettings

SHORT_S = 5.0
"""A connection that ended sooner is the newcomer's; longer than any daemon needs to reconnect."""
UNEXPLAINED = 3
"""Short connections in a row, without a reason from the broker, before another daemon is suspected.
MQTT 3.1.1 has no reasons, and some MQTT 5 brokers send none."""
GLANCE_S = 2.0
"""Time to look for poses of a suspected daemon."""
SETTLED_S = 5.0
"""`offline` may be the will of our own ended connection; it counts if no message follows so long.
"""


class TakeoverDetector:
    """Counts the short connections that may have been ended by another daemon."""

    def __init__(self) -> None:
        self._unexplained = 0

    def suspects(self, lasted_s: float, *, taken_over: bool) -> bool:
        """Return whether the connection that just ended should be left to another daemon.

        Parameters
        ----------
        lasted_s
            How long it was established, s.
        taken_over
            Whether the broker gave "session taken over" as reason.
        """
        short = 0.0 < lasted_s < SHORT_S
        self._unexplained = self._unexplained + 1 if short else 0
        return short and (taken_over or self._unexplained >= UNEXPLAINED)


async def is_publishing(settings: MqttSettings, within_s: float) -> bool:
    """Return whether poses arrive below the base, while this daemon is not connected.

    Raises
    ------
    BrokerLostError
        The broker went away.
    """
    async with MqttConnection(settings) as watch:
        await watch.subscribe([f"{settings.base}/pose"])
        try:
            async with asyncio.timeout(within_s):
                await anext(watch.messages())
        except TimeoutError:
            return False
    return True


async def await_departure(settings: MqttSettings, offline: bytes) -> None:
    """Return when the other daemon is offline or silent.

    Silent means no pose and no health for more than two of its health intervals, taken from our
    own settings.

    Raises
    ------
    BrokerLostError
        The broker went away.
    """
    life, health = f"{settings.base}/bridge/state", f"{settings.base}/bridge/health"
    loop = asyncio.get_running_loop()
    silence_s = 2 * settings.health_s + SETTLED_S
    async with MqttConnection(settings) as watch:
        await watch.subscribe([f"{settings.base}/pose", health, life])
        stored = {health, life}  # the first of a retained topic may be old
        try:
            async with asyncio.timeout(silence_s) as patience:
                async for message in watch.messages():
                    if message.topic == life and message.payload == offline:
                        patience.reschedule(loop.time() + SETTLED_S)
                    elif message.topic in stored:
                        stored.discard(message.topic)
                    else:
                        patience.reschedule(loop.time() + silence_s)
        except TimeoutError:
            return
