"""The daemon's own connection to the broker: it publishes the outbox and passes on requests.

Invariant: `MqttPublisher.run` ends only by cancellation, whatever the broker does. Requests are
passed on synchronously and at a limited rate. Retained requests are never passed on.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar

from jointfit_daemon.outputs import topics
from jointfit_daemon.outputs.mqtt._competing_daemon import (
    GLANCE_S,
    NEWCOMER_S,
    SHORT_S,
    TakeoverDetector,
    await_departure,
    is_in_use,
    is_publishing,
)
from jointfit_daemon.outputs.mqtt._connection import (
    BrokerLostError,
    Incoming,
    MqttConnection,
    Outgoing,
    stop_if_cancelled,
)
from jointfit_daemon.outputs.mqtt._error_messages import (
    CONNECTION_CLOSED,
    CONNECTION_LOST,
    NO_ANSWER,
)
from jointfit_daemon.outputs.mqtt._secret_files import missing_password, security_warnings
from jointfit_daemon.outputs.token_bucket import TokenBucket
from jointfit_daemon.outputs.topics import OFFLINE, ONLINE

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.config import MqttSettings
    from jointfit_daemon.outputs.mqtt._outbox import Outbox

log = logging.getLogger(__name__)

ECHO_S = 5.0
"""Time within which the broker must return the daemon's own message, s. If the message does not
come back, the broker's access list may forbid its publication or delivery."""
REQUEST_RATE_HZ = 10.0
"""Permitted mean rate of requests, 1/s. A person needs several seconds per request."""
REQUEST_BURST = 20.0
"""Permitted number of requests without waiting after a pause."""
CHECK_S = 10.0
"""Interval at which one message of each stream is sent with QoS 1, s. The acknowledgement shows
whether the broker refuses the topic."""
_NOTICE_S = 10.0
"""Shortest interval between log lines on ignored requests, s."""
_CORRECTION_S = 0.1
"""Delay before ``bridge/state`` of another process is overwritten, s. The delay limits the
corrections to ten per second."""
_POLL_S = 0.01
"""Interval between checks whether the outbox is empty, s."""
_FIRST_RETRY_S = 0.05
"""Wait before the first retry, s. A broker that reset one connection may accept the next one."""
_LAST_RETRY_S = 0.6
"""Longest wait before a retry, s. A refused attempt costs little, and a user may be waiting."""
_HEALTHY_S = 5.0
"""Duration after which a connection counts as successful and resets the wait, s."""


@dataclass(frozen=True, slots=True)
class LinkHealth:
    """State of the connection to the broker; docs/mqtt.md explains the fields.

    The payload of ``bridge/health`` contains exactly these fields.
    """

    __pydantic_config__: ClassVar = {"extra": "forbid"}

    connected: bool
    connects: int
    confirmed: bool
    """Whether the broker accepts and returns the daemon's messages."""
    denied: list[str]
    """Topics below the base on which the broker refuses messages."""
    sent: int
    queued: int
    dropped: int
    ignored_requests: int
    noise: int
    """Number of harmless errors that the MQTT library raised about closed connections."""


class MqttPublisher:
    """Publishes an outbox and passes on requests; it reconnects after a loss of the connection.

    Parameters
    ----------
    settings
        Table ``[mqtt]``: address of the broker, and ``settings.base``, with which every topic
        begins.
    outbox
        Messages to publish.
    on_request
        Function that is called with each request, except retained requests and requests above the
        permitted rate. It must not block.
    """

    def __init__(
        self, settings: MqttSettings, outbox: Outbox, on_request: Callable[[Incoming], None]
    ) -> None:
        self._settings, self._outbox, self._on_request = settings, outbox, on_request
        self._base = settings.base
        self._requests = topics.REQUEST.name(settings.base)
        self._reported = ""
        self._takeovers = TakeoverDetector()
        self._lasted_s, self._taken_over = 0.0, False
        self._loop = asyncio.get_running_loop()
        self._requests_left = TokenBucket(REQUEST_RATE_HZ, REQUEST_BURST, self._loop.time())
        self._notice_due_s = 0.0
        self._modern = settings.version == "5"

        # With MQTT 3.1.1, only a message that comes back proves that the broker accepted it.
        own = [outbox.state_topic]
        if not self._modern:
            own.append(topics.POSE.name(settings.base))
        self._echoes = {topic: _TopicEcho() for topic in own}

        discovery = settings.home_assistant
        self._birth = "" if discovery is None else f"{discovery.prefix}/status"
        self._checked_s: dict[str, float] = {}
        self._connection: MqttConnection | None = None
        self.connected = False
        self.connects = self.sent = 0
        self.ignored_requests = 0
        """Number of ignored requests: retained, above the permitted rate, or too long."""
        self.denied: set[str] = set()
        """Topics on which the broker refuses this daemon's messages."""
        self._correcting = False
        outbox.retain(outbox.state_topic, ONLINE)

    @property
    def outbox(self) -> Outbox:
        """Messages to publish."""
        return self._outbox

    @property
    def base(self) -> str:
        """Levels with which all topics begin."""
        return self._base

    def health(self, noise: int = 0) -> LinkHealth:
        """Return the state of the connection; `noise` is the count of `DisconnectErrorFilter`."""
        echoed = self._echoes[self._outbox.state_topic].arrived.is_set()
        oversized = 0 if self._connection is None else self._connection.oversized
        return LinkHealth(
            connected=self.connected,
            connects=self.connects,
            confirmed=echoed and not self.denied,
            denied=sorted(topic.removeprefix(f"{self._base}/") for topic in self.denied),
            sent=self.sent,
            queued=self._outbox.queued,
            dropped=self._outbox.dropped,
            ignored_requests=self.ignored_requests + oversized,
            noise=noise,
        )

    async def run(self) -> None:
        """Connect and serve until cancelled; reconnect after each loss."""
        for warning in security_warnings(self._settings):
            log.warning("mqtt: %s", warning)
        if (missing := missing_password(self._settings)) is not None:
            log.warning(
                "mqtt: no password for user %s: connecting without; %s",
                self._settings.username,
                missing,
            )

        delay_s = _FIRST_RETRY_S
        while True:
            began_s = self._loop.time()
            # Each connection has its own task; `_serve` states the reason.
            attempt = asyncio.create_task(self._serve(), name="mqtt connection")
            reason = ""
            try:
                # A TaskGroup would drop a cancellation that coincides with a failure.
                await attempt
            except* BrokerLostError as lost:
                error: BaseException = lost
                while isinstance(error, BaseExceptionGroup):
                    error = error.exceptions[0]
                reason = str(error)
            stop_if_cancelled()

            # After a connection of at least `NEWCOMER_S`, the daemon reconnects at once; see
            # `TakeoverDetector`.
            lasted_s, self._lasted_s = self._lasted_s, 0.0
            if lasted_s >= NEWCOMER_S:
                delay_s = _FIRST_RETRY_S

            try:
                # In a takeover, another client connects with this client id, and the broker closes
                # the connection. A missing answer of the broker is therefore not caused by a
                # takeover.
                silent = NO_ANSWER in reason
                if silent or not await self._pause_if_competing(lasted_s):
                    self._report_loss(reason, lasted_s)
            except BrokerLostError as lost:
                self._report(str(lost))

            if self._loop.time() - began_s > _HEALTHY_S:
                delay_s = _FIRST_RETRY_S
            await asyncio.sleep(delay_s * random.uniform(0.5, 1.0))  # noqa: S311 - no secret
            delay_s = min(2 * delay_s, _LAST_RETRY_S)

    async def flush(self, within_s: float, *, streams: bool = False) -> None:
        """Wait at most `within_s` until the broker has accepted responses, state and events.

        If the daemon is not connected, the method returns at once. With `streams`, it also waits
        until all other messages are sent.
        """
        until, outbox = self._loop.time() + within_s, self._outbox
        while self.connected and self._loop.time() < until:
            if not (outbox.has_unsent or (streams and not outbox.is_empty)):
                break
            await asyncio.sleep(_POLL_S)

    @property
    def _contested(self) -> str:
        return (
            f"broker {self._settings.host}:{self._settings.tcp_port}: another client uses the "
            f"client id {topics.client_identifier(self._base)!r}, probably a second jointfitd with "
            f"base {self._base}: stop one of them, or give each rig its own name"
        )

    async def _pause_if_competing(self, lasted_s: float) -> bool:
        """If an older daemon uses the client id, wait until it ends; return whether this happened.

        The client id belongs to the daemon that used it first.
        """
        if not self._takeovers.suspects(lasted_s, taken_over=self._taken_over):
            return False
        if not (self._taken_over or await is_publishing(self._settings, GLANCE_S)):
            return False

        self._takeovers.restart_count()
        await self._pause()
        return True

    async def _pause(self) -> None:
        log.error("mqtt: %s. Publishing is paused until the other client is gone", self._contested)
        await await_departure(self._settings, OFFLINE)
        log.warning("mqtt: the other client with this client id is gone: connecting")

    def _report_loss(self, reason: str, lasted_s: float) -> None:
        """Log the reason why the last attempt or connection ended."""
        if lasted_s >= SHORT_S:
            self._reported = ""  # short connections in a row share one log line
        if lasted_s > 0.0 and self._taken_over:
            reason = self._contested
        elif lasted_s > 0.0 and (CONNECTION_LOST in reason or CONNECTION_CLOSED in reason):
            # The text of the error depends on the operation that fails first, which is random. A
            # takeover without a reason causes the same errors.
            reason = (
                f"broker {self._settings.host}:{self._settings.tcp_port}: the connection ended "
                "without a reason: the broker stopped, the network failed, or another client uses "
                f"the client id {topics.client_identifier(self._base)!r}"
            )
        self._report(reason)

    def _report(self, reason: str) -> None:
        if reason != self._reported:  # log one line per change, not per attempt
            log.warning("mqtt: %s; retrying", reason)
            self._reported = reason

    async def _serve(self) -> None:
        """Serve one connection.

        Each connection has its own task, because in Python 3.11 a task that contained a failed
        TaskGroup appears cancelled from then on.
        """
        if self.connects == 0:
            # A connection takes over the client id. The broker then publishes the will of a daemon
            # that used this id, so the check comes first. The next attempt to connect reports a
            # fault of the broker.
            with contextlib.suppress(BrokerLostError):
                if await is_in_use(self._settings, OFFLINE):
                    await self._pause()

        will = Outgoing(self._outbox.state_topic, OFFLINE, 1, retain=True)
        name = topics.client_identifier(self._base)
        async with MqttConnection(
            self._settings, name, will=will, farewell=will, admit=self._admit
        ) as connection:
            self._connection = connection
            self.connects, self.connected = self.connects + 1, True
            log.info("mqtt: connected to %s:%d", self._settings.host, self._settings.tcp_port)
            self._checked_s.clear()
            for echo in self._echoes.values():
                echo.clear()
            self._outbox.requeue_state()
            began_s, self._taken_over = self._loop.time(), False

            try:
                async with asyncio.TaskGroup() as tasks:
                    tasks.create_task(self._listen(connection), name="mqtt requests")
                    tasks.create_task(self._subscribe(connection), name="mqtt subscriptions")
                    tasks.create_task(self._write(connection), name="mqtt writer")
                    for topic in self._echoes:
                        tasks.create_task(self._await_echo(topic), name=f"mqtt echo of {topic}")
            finally:
                self.connected = False
                self._lasted_s = self._loop.time() - began_s
                self._taken_over = connection.taken_over
                self.ignored_requests += connection.oversized
                self._connection = None

    async def _write(self, connection: MqttConnection) -> None:
        while True:
            message, sent = await self._outbox.next()
            if message.qos == 0 and self._modern:
                # Once per `CHECK_S`, a message of each stream is sent with QoS 1, so that it is
                # acknowledged.
                topic, now_s = message.topic, self._loop.time()
                if now_s >= self._checked_s.get(topic, now_s):
                    self._checked_s[topic] = now_s + CHECK_S
                    message = replace(message, qos=1)

            await connection.send(message, partial(self._note_acceptance, message, sent))

    def _note_acceptance(
        self, message: Outgoing, sent: Callable[[], None], refusal: str | None
    ) -> None:
        """Process the acceptance or refusal of `message` by the broker (QoS 0: the kernel)."""
        sent()
        self.sent += 1
        if message.written is not None and not message.qos:
            message.written()
        if message.qos and self._modern:
            # Log when the broker begins to refuse messages on this topic.
            topic = message.topic
            if topic.startswith(responses := topics.RESPONSE.name(self._base)):
                topic = responses + "#"  # clients choose the last levels, so all share one entry

            if refusal is None:
                self.denied.discard(topic)
            elif topic not in self.denied:
                self.denied.add(topic)
                log.warning(
                    "mqtt: the broker refuses messages on %s (%s): allow them in its ACL",
                    topic,
                    refusal,
                )
        if (echo := self._echoes.get(message.topic)) is not None:
            echo.sent.set()

    async def _subscribe(self, connection: MqttConnection) -> None:
        wanted = [f"{self._requests}+", *self._echoes, *filter(None, [self._birth])]
        refused = await connection.subscribe(wanted, live=True)
        for topic in refused:
            log.warning("mqtt: the broker refuses the subscription to %s: check its ACL", topic)

    async def _listen(self, connection: MqttConnection) -> None:
        async for message in connection.messages():
            if message.topic == self._birth:
                if message.payload == b"online":  # Home Assistant was started
                    self._outbox.repeat(self._birth.removesuffix("status"))
                continue
            echo = self._echoes.get(message.topic)
            if echo is None:
                self._on_request(message)
                continue

            # With MQTT 3.1.1, a retained message comes from an earlier process. With MQTT 5, new
            # messages are marked as retained as well, but the broker sends no stored messages.
            if message.retained and not self._modern:
                continue
            if message.topic == self._outbox.state_topic:
                if message.payload == ONLINE:
                    echo.arrived.set()
                elif echo.arrived.is_set() and not self._correcting:  # late will of another process
                    self._correcting = True
                    self._loop.call_later(_CORRECTION_S, self._correct_state)
            elif not echo.arrived.is_set():
                echo.arrived.set()
                await connection.unsubscribe(message.topic)
            self.denied.discard(message.topic)

    def _admit(self, topic: str, retained: bool) -> bool:
        """Return whether a message is passed on; otherwise count and log the ignored request."""
        if topic in self._echoes or topic == self._birth:
            return True
        if retained:
            reason = "it is retained and would run at every start: send requests without retain"
        elif not self._requests_left.take(self._loop.time()):
            reason = f"more than {REQUEST_RATE_HZ:g} requests per second"
        else:
            return True

        self.ignored_requests += 1
        if (now_s := self._loop.time()) >= self._notice_due_s:
            self._notice_due_s = now_s + _NOTICE_S
            log.warning(
                "mqtt: ignored a request below %s: %s (%d ignored so far)",
                self._requests,
                reason,
                self.ignored_requests,
            )
        return False

    def _correct_state(self) -> None:
        self._correcting = False
        self._outbox.retain(self._outbox.state_topic, OFFLINE)
        self._outbox.retain(self._outbox.state_topic, ONLINE)

    async def _await_echo(self, topic: str) -> None:
        """Check that messages on `topic` come back; an acknowledgement may hide a refusal."""
        echo = self._echoes[topic]
        await echo.sent.wait()
        try:
            async with asyncio.timeout(ECHO_S):
                await echo.arrived.wait()
        except TimeoutError:
            if not self._modern:  # with MQTT 5, acknowledgements contain refusals
                self.denied.add(topic)
            log.warning(
                "mqtt: the daemon's own message on %s does not come back: the broker may forbid "
                "messages below %s; check its ACL",
                topic,
                self._base,
            )


class _TopicEcho:
    """State of the check whether the broker returned a message that the daemon sent."""

    def __init__(self) -> None:
        self.sent, self.arrived = asyncio.Event(), asyncio.Event()

    def clear(self) -> None:
        self.sent.clear()
        self.arrived.clear()
