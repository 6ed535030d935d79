"""The daemon's own connection to the broker. Law: it never ends by itself and never blocks others.

Whatever happens to the broker, `run` goes on trying and the outbox goes on taking; requests are
handed on synchronously, at a bounded rate, and are never taken from a retained message.
"""

from __future__ import annotations

import asyncio
import logging
import random
from dataclasses import replace
from typing import TYPE_CHECKING

from jointfit_daemon.outputs.log import TokenBucket
from jointfit_daemon.outputs.mqtt._competing_daemon import (
    GLANCE_S,
    TakeoverDetector,
    await_departure,
    is_publishing,
)
from jointfit_daemon.outputs.mqtt._connection import (
    BrokerLostError,
    Incoming,
    MqttConnection,
    Outgoing,
    stop_if_cancelled,
)
from jointfit_daemon.outputs.mqtt._secret_files import password_of, security_warnings

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.config import MqttSettings
    from jointfit_daemon.outputs.mqtt._outbox import Outbox

log = logging.getLogger(__name__)

ONLINE, OFFLINE = b'{"v":1,"state":"online"}', b'{"v":1,"state":"offline"}'
ECHO_S = 5.0  # own "online" comes back within this, or the broker does not let it pass
REQUEST_RATE_HZ = 10.0
"""Requests handed on a second; a person sends one in several seconds."""
REQUEST_BURST = 20.0
"""Requests handed on at once, after a quiet time."""
CHECK_S = 10.0
"""A stream's topic is published at QoS 1 this often: the acknowledgement holds a refusal."""
_NOTICE_S = 10.0
"""Ignored requests are logged at most this often."""
_CORRECTION_S = 0.1
"""A foreign bridge/state is corrected after so long: a flood costs ten messages a second."""
_LOOK_S = 0.01
_FIRST_RETRY_S = 0.05
"""Wait before the first retry: a broker that reset one connection may accept the next."""
_LAST_RETRY_S = 0.6
"""Longest wait: a refused connect costs nothing, a longer wait costs the user a second."""
_HEALTHY_S = 5.0
"""A connection that lasted so long resets the wait."""


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
        self._base = settings.base
        self._requests = f"{settings.base}/bridge/request/"
        self._said = ""
        self._rivals = TakeoverDetector()
        self._lasted_s, self._taken_over = 0.0, False
        self._loop = asyncio.get_running_loop()
        self._allowance = TokenBucket(REQUEST_RATE_HZ, REQUEST_BURST, self._loop.time())
        self._notice_due_s = 0.0
        self._modern = settings.version == "5"
        # With MQTT 3.1.1 only a message that comes back shows that it was let through.
        own = [outbox.life] if self._modern else [outbox.life, f"{settings.base}/pose"]
        self._echoes = {topic: _Echo() for topic in own}
        self._checked_s: dict[str, float] = {}
        self._connection: MqttConnection | None = None
        self.connected = False
        self.connects = self.sent = 0
        self.ignored_requests = 0
        """Requests that were retained, beyond the rate, or too long for the connection."""
        self.denied: set[str] = set()
        """Topics on which the broker does not let us publish."""
        self._correcting = False
        outbox.retain(outbox.life, ONLINE)

    def figures(self) -> dict[str, object]:
        """Return the link's part of the health message."""
        return {
            "connected": self.connected,
            "connects": self.connects,
            "confirmed": self._echoes[self._outbox.life].came.is_set() and not self.denied,
            "denied": sorted(topic.removeprefix(f"{self._base}/") for topic in self.denied),
            "sent": self.sent,
            "queued": self._outbox.queued,
            "dropped": self._outbox.dropped,
            "ignored_requests": self.ignored_requests + self._oversized(),
        }

    def _oversized(self) -> int:
        return 0 if self._connection is None else self._connection.oversized

    async def run(self) -> None:
        """Connect, serve, and begin again, until cancelled."""
        for exposure in security_warnings(self._settings):
            log.warning("mqtt: %s", exposure)
        if self._settings.username is not None and password_of(self._settings) is None:
            log.warning(
                "mqtt: user %s has no password file: trying without", self._settings.username
            )
        delay_s = _FIRST_RETRY_S
        while True:
            began_s = self._loop.time()
            attempt = asyncio.create_task(self._serve(), name="mqtt connection")  # see _serve
            reason = ""
            try:
                await attempt  # no TaskGroup: it forgets a cancellation that meets a loss
            except* BrokerLostError as lost:
                reason = _first(lost)
            stop_if_cancelled()
            try:
                if not await self._gave_way():
                    self._tell(self._contested if self._taken_over else reason)
            except BrokerLostError as lost:
                self._tell(str(lost))
            if self._loop.time() - began_s > _HEALTHY_S:
                delay_s = _FIRST_RETRY_S
            await asyncio.sleep(delay_s * random.uniform(0.5, 1.0))  # noqa: S311 - no secret
            delay_s = min(2 * delay_s, _LAST_RETRY_S)

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
            f"with our client id {client_identifier(self._settings.base)!r}: a second jointfitd "
            f"with base {self._settings.base}? Stop one, or give each rig its own name"
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
        name = client_identifier(self._settings.base)
        async with MqttConnection(
            self._settings, name, will=will, farewell=will, admit=self._admit
        ) as connection:
            self._connection = connection
            self.connects, self.connected, self._said = self.connects + 1, True, ""
            log.info("mqtt: connected to %s:%d", self._settings.host, self._settings.tcp_port)
            self._checked_s.clear()
            for echo in self._echoes.values():
                echo.clear()
            self._outbox.reconnected()
            began_s, self._taken_over = asyncio.get_running_loop().time(), False
            try:
                async with asyncio.TaskGroup() as tasks:
                    tasks.create_task(self._listen(connection), name="mqtt requests")
                    tasks.create_task(self._subscribe(connection), name="mqtt subscriptions")
                    tasks.create_task(self._write(connection), name="mqtt writer")
                    for topic in self._echoes:
                        tasks.create_task(self._await_echo(topic), name=f"mqtt echo of {topic}")
            finally:
                self.connected = False
                self._lasted_s = asyncio.get_running_loop().time() - began_s
                self._taken_over = connection.taken_over
                self.ignored_requests += connection.oversized
                self._connection = None

    async def _write(self, connection: MqttConnection) -> None:
        while True:
            message, done = await self._outbox.next()
            if message.qos == 0 and self._modern and self._is_check_due(message.topic):
                message = replace(message, qos=1)
            refusal = await connection.publish(message)
            done()
            self.sent += 1
            if message.qos and self._modern:
                self._note_acknowledgement(message.topic, refusal)
            if (echo := self._echoes.get(message.topic)) is not None:
                echo.wanted.set()

    def _is_check_due(self, topic: str) -> bool:
        now_s = self._loop.time()
        if now_s < self._checked_s.get(topic, now_s):
            return False
        self._checked_s[topic] = now_s + CHECK_S
        return True

    def _note_acknowledgement(self, topic: str, refusal: str | None) -> None:
        """Note whether the broker accepted a message on `topic`; log when that changes."""
        if topic.startswith(responses := f"{self._base}/bridge/response/"):
            topic = responses + "#"  # requesters choose these topics: one entry for all
        if refusal is None:
            self.denied.discard(topic)
        elif topic not in self.denied:
            self.denied.add(topic)
            log.warning(
                "mqtt: the broker refuses what we publish on %s (%s): allow it in its ACL",
                topic,
                refusal,
            )

    async def _subscribe(self, connection: MqttConnection) -> None:
        refused = await connection.subscribe([f"{self._requests}+", *self._echoes], live=True)
        for topic in refused:
            log.warning("mqtt: the broker does not let us subscribe to %s: check its ACL", topic)

    async def _listen(self, connection: MqttConnection) -> None:
        async for message in connection.messages():
            if message.topic in self._echoes:
                await self._take_echo(connection, message)
            else:
                self._on_request(message)

    def _admit(self, topic: str, retained: bool) -> bool:
        """Return whether a message may pass; count a request that may not."""
        if topic in self._echoes:
            return True
        if retained:
            self._ignore("it is retained and would run at every start; do not retain requests")
            return False
        if not self._allowance.take(self._loop.time()):
            self._ignore(f"more than {REQUEST_RATE_HZ:g} a second arrive")
            return False
        return True

    async def _take_echo(self, connection: MqttConnection, message: Incoming) -> None:
        if message.retained and not self._modern:
            return  # stored by a predecessor; MQTT 5 marks fresh messages, too, and sends no others
        echo = self._echoes[message.topic]
        if message.topic == self._outbox.life:
            if message.payload == ONLINE:
                echo.came.set()
            elif echo.came.is_set() and not self._correcting:  # a predecessor's will, come late
                self._correcting = True
                self._loop.call_later(_CORRECTION_S, self._correct_state)
        elif not echo.came.is_set():
            echo.came.set()
            await connection.unsubscribe(message.topic)
        self.denied.discard(message.topic)

    def _ignore(self, reason: str) -> None:
        """Count a request that is not handed on; log at most one in a while."""
        self.ignored_requests += 1
        if (now_s := self._loop.time()) >= self._notice_due_s:
            self._notice_due_s = now_s + _NOTICE_S
            log.warning(
                "mqtt: ignored a request below %s: %s (%d ignored so far)",
                self._requests,
                reason,
                self.ignored_requests,
            )

    def _correct_state(self) -> None:
        self._correcting = False
        self._outbox.retain(self._outbox.life, OFFLINE)
        self._outbox.retain(self._outbox.life, ONLINE)

    async def _await_echo(self, topic: str) -> None:
        """Check that what we publish on `topic` is let through: a forbidden publish "succeeds"."""
        echo = self._echoes[topic]
        await echo.wanted.wait()
        try:
            async with asyncio.timeout(ECHO_S):
                await echo.came.wait()
        except TimeoutError:
            if not self._modern:  # else acknowledgements tell
                self.denied.add(topic)
            log.warning(
                "mqtt: our own %s does not come back: the broker may forbid us to publish below "
                "%s; check its ACL",
                topic,
                self._base,
            )


class _Echo:
    """Whether a message of ours was sent, and whether it came back."""

    def __init__(self) -> None:
        self.wanted, self.came = asyncio.Event(), asyncio.Event()

    def clear(self) -> None:
        self.wanted.clear()
        self.came.clear()


def client_identifier(base: str) -> str:
    """Return the daemon's client id: fixed, so that it takes over from its dead predecessor.

    Only letters, digits and dashes: rumqttd breaks on a slash.
    """
    return "jointfitd-" + "".join(
        letter if letter.isascii() and letter.isalnum() else "-" for letter in base
    )


def command_of(message: Incoming) -> str:
    """Return the last level of a request's topic."""
    return message.topic.rpartition("/")[2]


def _first(group: BaseExceptionGroup[BrokerLostError]) -> str:
    error: BaseException = group
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return str(error)
