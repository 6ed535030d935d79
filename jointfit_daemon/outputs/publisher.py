"""The daemon's own connection to the broker. Law: it never ends by itself and never blocks others.

Whatever happens to the broker, `run` goes on trying and the outbox goes on taking; requests are
handed on synchronously and are never taken from a retained message.
"""

from __future__ import annotations

import asyncio
import logging
import random
from typing import TYPE_CHECKING

from jointfit_daemon.outputs.mqtt import (
    BrokerLost,
    Incoming,
    MqttConnection,
    Outgoing,
    stop_if_cancelled,
)
from jointfit_daemon.outputs.mqtt_rival import (
    GLANCE_S,
    RivalDetector,
    await_departure,
    is_publishing,
)
from jointfit_daemon.outputs.mqtt_secrets import exposures, password_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.config import MqttSettings
    from jointfit_daemon.outputs.outbox import Outbox

log = logging.getLogger(__name__)

ONLINE, OFFLINE = b'{"state":"online"}', b'{"state":"offline"}'
ECHO_S = 5.0  # own "online" comes back within this, or the broker does not let it pass
_LOOK_S = 0.01
_RETRY_S = (0.3, 0.6)  # a refused connect costs nothing, a longer wait costs the user a second


class MqttPublisher:
    """Keeps a broker supplied from an outbox and hands its requests on.

    Parameters
    ----------
    settings
        Where the broker is; ``settings.base`` begins every topic.
    outbox
        What to publish.
    on_request
        Called with each request that is not retained; must not block.
    """

    def __init__(
        self, settings: MqttSettings, outbox: Outbox, on_request: Callable[[Incoming], None]
    ) -> None:
        self._settings, self._outbox, self._on_request = settings, outbox, on_request
        self._requests = f"{settings.base}/bridge/request/"
        self._said = ""
        self._echo = asyncio.Event()
        self._rivals = RivalDetector()
        self._lasted_s, self._taken_over = 0.0, False
        self.connected = False
        self.connects = self.sent = self.retained_requests = 0
        outbox.retain(outbox.life, ONLINE)

    def figures(self) -> dict[str, object]:
        """Return the link's part of the health message."""
        return {
            "connected": self.connected,
            "connects": self.connects,
            "confirmed": self._echo.is_set(),
            "sent": self.sent,
            "queued": self._outbox.queued,
            "dropped": self._outbox.dropped,
        }

    async def run(self) -> None:
        """Connect, serve, and begin again, until cancelled."""
        for exposure in exposures(self._settings):
            log.warning("mqtt: %s", exposure)
        if self._settings.username is not None and password_of(self._settings) is None:
            log.warning(
                "mqtt: user %s has no password file: trying without", self._settings.username
            )
        while True:
            attempt = asyncio.create_task(self._serve(), name="mqtt connection")  # see _serve
            reason = ""
            try:
                await attempt  # no TaskGroup: it forgets a cancellation that meets a loss
            except* BrokerLost as lost:
                reason = _first(lost)
            stop_if_cancelled()
            try:
                if not await self._gave_way():
                    self._tell(self._contested if self._taken_over else reason)
            except BrokerLost as lost:
                self._tell(str(lost))
            await asyncio.sleep(random.uniform(*_RETRY_S))  # noqa: S311 - no secret

    async def emptied(self, within_s: float) -> None:
        """Wait until the broker has all state and events; not for long, nor without a broker."""
        loop = asyncio.get_running_loop()
        until = loop.time() + within_s
        while self.connected and self._outbox.unsaid and loop.time() < until:  # noqa: ASYNC110 - 3 facts
            await asyncio.sleep(_LOOK_S)

    @property
    def _contested(self) -> str:
        return (
            f"broker {self._settings.host}:{self._settings.tcp_port}: another client connected "
            f"with our client id {client_id(self._settings.base)!r}: a second jointfitd with "
            f"base {self._settings.base}? Stop one, or give each rig its own name"
        )

    async def _gave_way(self) -> bool:
        """Leave the client id to a daemon that had it before us, until that one is gone."""
        lasted_s, self._lasted_s = self._lasted_s, 0.0
        if not self._rivals.suspects(lasted_s, taken_over=self._taken_over):
            return False
        if not (self._taken_over or await is_publishing(self._settings, GLANCE_S)):
            return False
        log.error("mqtt: %s. That one was first: publishing waits until it ends", self._contested)
        await await_departure(self._settings, OFFLINE)
        log.warning("mqtt: the other client with our client id is gone: connecting")
        return True

    def _tell(self, reason: str) -> None:
        if reason != self._said:  # a line when something changes, not one per attempt
            log.warning("mqtt: %s; trying again", reason)
            self._said = reason

    async def _serve(self) -> None:
        """Serve one connection.

        A task that held a failed TaskGroup looks cancelled ever after (Python 3.11), so this runs
        once in a task.
        """
        life = self._outbox.life
        will = Outgoing(life, OFFLINE, 1, retain=True)
        name = client_id(self._settings.base)
        async with MqttConnection(self._settings, name, will=will, farewell=will) as connection:
            self.connects, self.connected, self._said = self.connects + 1, True, ""
            log.info("mqtt: connected to %s:%d", self._settings.host, self._settings.tcp_port)
            self._echo.clear()
            self._outbox.reconnected()
            began_s, self._taken_over = asyncio.get_running_loop().time(), False
            try:
                async with asyncio.TaskGroup() as tasks:
                    tasks.create_task(self._listen(connection), name="mqtt requests")
                    tasks.create_task(self._write(connection), name="mqtt writer")
                    tasks.create_task(self._await_echo(), name="mqtt self-test")
            finally:
                self.connected = False
                self._lasted_s = asyncio.get_running_loop().time() - began_s
                self._taken_over = connection.taken_over

    async def _write(self, connection: MqttConnection) -> None:
        while True:
            message, done = await self._outbox.next()
            await connection.publish(message)
            done()
            self.sent += 1

    async def _listen(self, connection: MqttConnection) -> None:
        refused = await connection.subscribe([f"{self._requests}+", self._outbox.life])
        for topic in refused:
            log.warning("mqtt: the broker does not let us subscribe to %s: check its ACL", topic)
        async for message in connection.messages():
            if message.topic == self._outbox.life:
                self._heard_of_self(message)
            elif message.retained:
                self.retained_requests += 1
                log.warning(
                    "mqtt: ignored a retained request on %s: it would run at every start; "
                    "send requests without the retain flag",
                    message.topic,
                )
            else:
                self._on_request(message)

    def _heard_of_self(self, message: Incoming) -> None:
        if message.payload == ONLINE:
            self._echo.set()
        elif self._echo.is_set():  # a predecessor's will, come late
            self._outbox.retain(self._outbox.life, OFFLINE)
            self._outbox.retain(self._outbox.life, ONLINE)

    async def _await_echo(self) -> None:
        """Check that what we publish is let through: a forbidden publish "succeeds"."""
        try:
            async with asyncio.timeout(ECHO_S):
                await self._echo.wait()
        except TimeoutError:
            log.warning(
                "mqtt: our own %s does not come back: the broker may forbid us to publish below "
                "%s; check its ACL",
                self._outbox.life,
                self._settings.base,
            )


def client_id(base: str) -> str:
    """Return the daemon's client id: fixed, so that it takes over from its dead predecessor.

    Only letters, digits and dashes: rumqttd breaks on a slash.
    """
    return "jointfitd-" + "".join(
        letter if letter.isascii() and letter.isalnum() else "-" for letter in base
    )


def command_of(message: Incoming) -> str:
    """Return the last level of a request's topic."""
    return message.topic.rpartition("/")[2]


def _first(group: BaseExceptionGroup[BrokerLost]) -> str:
    error: BaseException = group
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return str(error)
