"""Detection of another daemon with the same client id, and the wait until that daemon ends.

A broker ends the older of two connections with one client id, so two daemons with the same base
topic would end each other's connection repeatedly. Before its first connection, a daemon therefore
connects with another client id and waits for messages of another daemon. If it receives such a
message, it publishes nothing until the other daemon ends.

This check fails if two daemons start together, or if the broker has lost the state of a daemon. In
these cases the daemon that was connected first, the older daemon, connects again with its client
id. The newer daemon must give way: it connects with another client id and waits until the other
daemon is gone.

Neither daemon knows when the other daemon connected. Each daemon compares the duration of its own
first connection with a limit that doubles with every further loss. The first connection of the
newer daemon lasts only until the older daemon reconnects. The newer daemon is therefore the first
of the two daemons whose duration is below the limit. Only the disconnected daemon decides, while
the other daemon is connected, so the two daemons never give way at the same time.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from jointfit_daemon.outputs import topics
from jointfit_daemon.outputs.mqtt._connection import ANSWER_S, MqttConnection

if TYPE_CHECKING:
    from jointfit_daemon.config import MqttSettings

SHORT_S = 5.0
"""Connection time after which a daemon counts as established and earlier losses are ignored, s."""
NEWCOMER_S = 0.25
"""Limit, after one loss, for the duration of the first connection, s. The other daemon needs only a
fraction of this time to reconnect."""
UNEXPLAINED = 3
"""Number of consecutive short connections, ended without a reason from the broker, after which
another daemon is suspected. MQTT 3.1.1 has no reasons, and some MQTT 5 brokers send none."""
STORED_S = 0.1
"""Time to wait for the stored state of a daemon after two exchanges with the broker, s. Some
brokers send stored messages only after they confirm the subscription."""
GLANCE_S = 2.0
"""Time to wait for a pose of the suspected daemon, s."""
SETTLED_S = 5.0
"""Time without another message after which the state ``offline`` is accepted, s. The message may be
the will of this daemon's last connection, which the broker publishes if the connection breaks."""


class TakeoverDetector:
    """Determines from the durations of connections whether this daemon must give way."""

    def __init__(self) -> None:
        self._first_s = 0.0
        self._losses = 0

    def suspects(self, lasted_s: float, *, taken_over: bool) -> bool:
        """Return whether an older daemon probably ended the last connection.

        Let n be the number of consecutive short connections, minus 2 if the broker gave no reason
        for the last loss. The result is True if n is at least 1, and the first connection was
        shorter than ``NEWCOMER_S * 2**(n - 1)``. The first connection of an established daemon
        counts as `SHORT_S` long, so that one of two established daemons also gives way.

        Parameters
        ----------
        lasted_s
            Duration of the connection, s; 0 if the connection failed.
        taken_over
            Whether the broker stated the reason "session taken over".
        """
        if lasted_s <= 0.0 or lasted_s >= SHORT_S:
            self._first_s = max(self._first_s, min(lasted_s, SHORT_S))
            self._losses = 0
            return False

        # The durations of later connections of a series depend on the waits of both daemons, not
        # on their start times.
        if self._losses == 0:
            self._first_s = max(self._first_s, lasted_s)
        self._losses += 1

        doublings = self._losses - (1 if taken_over else UNEXPLAINED)
        return doublings >= 0 and self._first_s < NEWCOMER_S * 2**doublings

    def restart_count(self) -> None:
        """Treat this daemon as the newer one from now on, also after a restart of the broker."""
        self._first_s, self._losses = 0.0, 0


async def is_in_use(settings: MqttSettings, offline: bytes) -> bool:
    """Return whether another daemon publishes poses below the base topic.

    `offline` is the payload of the state of a stopped daemon.

    If a daemon ends without disconnecting, the broker keeps the state ``online`` for some seconds.
    This state therefore only extends the wait for a pose.

    Raises
    ------
    BrokerLostError
        The connection failed.
    """
    base = settings.base
    state = topics.BRIDGE_STATE.name(base)
    loop = asyncio.get_running_loop()
    async with MqttConnection(settings) as observer:
        try:
            async with asyncio.timeout(ANSWER_S) as patience:
                await observer.subscribe([state])
                await observer.subscribe([topics.POSE.name(base)], live=True)
                patience.reschedule(loop.time() + STORED_S)
                async for message in observer.messages():
                    if message.topic != state:
                        return True
                    if message.payload == offline:
                        return False
                    patience.reschedule(loop.time() + GLANCE_S)
        except TimeoutError:
            pass
    return False


async def is_publishing(settings: MqttSettings, within_s: float) -> bool:
    """Return whether a pose arrives within `within_s` while this daemon is disconnected.

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
    """Wait until the other daemon is offline or silent.

    Silent means that neither pose nor health arrives for more than two health intervals of this
    configuration.

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
