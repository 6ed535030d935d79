"""Detection of another daemon with the same client id, and the wait for its end.

A broker ends the older of two connections with one client id, so two daemons with the same base
topic would end each other's connection repeatedly. The daemon with the shorter connection gives
way: it connects with another client id and waits until the other daemon is gone.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from jointfit_daemon.outputs import topics
from jointfit_daemon.outputs.mqtt._connection import MqttConnection

if TYPE_CHECKING:
    from jointfit_daemon.config import MqttSettings

SHORT_S = 5.0
"""Connection time below which this daemon gives way, s; longer than any reconnection takes."""
UNEXPLAINED = 3
"""Short connections in a row, without a reason from the broker, that raise the suspicion: MQTT
3.1.1 has no reasons, and some MQTT 5 brokers send none."""
GLANCE_S = 2.0
"""Time to wait for a pose of a suspected daemon, s."""
SETTLED_S = 5.0
"""Time without a message after ``offline`` that confirms it, s: ``offline`` may be the will of our
own last connection."""


class TakeoverDetector:
    """Counts short connections that another daemon may have ended."""

    def __init__(self) -> None:
        self._unexplained = 0

    def suspects(self, lasted_s: float, *, taken_over: bool) -> bool:
        """Return whether another daemon probably ended the last connection.

        Parameters
        ----------
        lasted_s
            Duration of the connection, s.
        taken_over
            Whether the broker gave the reason "session taken over".
        """
        short = 0.0 < lasted_s < SHORT_S
        self._unexplained = self._unexplained + 1 if short else 0
        return short and (taken_over or self._unexplained >= UNEXPLAINED)


async def is_publishing(settings: MqttSettings, within_s: float) -> bool:
    """Return whether a pose arrives below the base while this daemon is disconnected.

    Raises
    ------
    BrokerLostError
        The connection failed.
    """
    async with MqttConnection(settings) as observer:
        await observer.subscribe([topics.POSE.name(settings.base)])
        try:
            async with asyncio.timeout(within_s):
                await anext(observer.messages())
        except TimeoutError:
            return False
    return True


async def await_departure(settings: MqttSettings, offline: bytes) -> None:
    """Return when the other daemon is offline or silent.

    Silent means no pose and no health for more than two health intervals of this configuration.

    Raises
    ------
    BrokerLostError
        The connection failed.
    """
    base = settings.base
    state, health = topics.BRIDGE_STATE.name(base), topics.BRIDGE_HEALTH.name(base)
    loop = asyncio.get_running_loop()
    silence_s = 2 * settings.health_s + SETTLED_S
    async with MqttConnection(settings) as observer:
        await observer.subscribe([topics.POSE.name(base), health, state])
        stored = {health, state}  # the first message of a retained topic may be old
        try:
            async with asyncio.timeout(silence_s) as patience:
                async for message in observer.messages():
                    if message.topic == state and message.payload == offline:
                        patience.reschedule(loop.time() + SETTLED_S)
                    elif message.topic in stored:
                        stored.discard(message.topic)
                    else:
                        patience.reschedule(loop.time() + silence_s)
        except TimeoutError:
            return
