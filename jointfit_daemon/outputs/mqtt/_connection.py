"""One connection to an MQTT broker.

Invariant: no other module of the daemon imports aiomqtt or paho, and every fault of a broker is
raised as `BrokerLostError`. A connection object can be used only once.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import aiomqtt
from paho.mqtt.client import MQTTMessageInfo
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.subscribeoptions import SubscribeOptions

from jointfit_daemon.outputs.mqtt._error_messages import (
    NO_ANSWER,
    VERSION_REFUSED,
    broker_fault,
    refusal_fault,
    session_fault,
)
from jointfit_daemon.outputs.mqtt._packet_limit import PacketLimitSocket
from jointfit_daemon.outputs.mqtt._paho_log import PahoLog
from jointfit_daemon.outputs.mqtt._publish_packet import PUBLISH, PublishEncoder
from jointfit_daemon.outputs.mqtt._secret_files import password_of
from jointfit_daemon.outputs.mqtt._tls import TlsFilesError, tls_context, tls_remedy
from jointfit_daemon.outputs.topics import PAYLOAD_VERSION

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator, Sequence
    from types import TracebackType

    from jointfit_daemon.config import MqttSettings

KEEPALIVE_S = 5
"""Keep-alive interval, s. An unresponsive broker is detected within 1.5 intervals."""
ANSWER_S = 3.0
"""Time limit of one exchange with the broker, s."""
WINDOW = 16
"""Largest number of messages that are sent before the first of them is acknowledged. Brokers
usually allow 20 or more; a broker may announce a smaller number (MQTT 5.0, 3.2.2.3.3)."""
SUBSCRIBED_S = 30.0
"""Time limit of a subscription, s. A broker may send thousands of stored messages first."""
GOODBYE_S = 1.0
"""Time limit of an orderly disconnect, s."""
_Properties: Any = Properties  # the constructor is not annotated, its attributes are dynamic

_UNREAD_CAPACITY = 64
"""Largest number of unread messages of a daemon; requests are rare."""
_REFUSED = 0x80
"""Lowest MQTT reason code of a refusal."""
_TAKEN_OVER = 0x8E
"""MQTT 5 reason code "session taken over"."""
_PROTOCOL_ERROR = 0x82
"""Reason code with which paho ends a connection that the broker refused with MQTT 3.1.1 code 1."""
_CLOSED_EARLY = "the broker closed the connection during the handshake"
_NOT_STORED = 2
"""MQTT 5 option "retain handling": the broker sends no stored messages for a subscription."""
LONGEST_PACKET_BYTES = 32 * 1024
"""Default limit of incoming packets, bytes. A pose of seventy segments is below this limit."""

_SOCKET_OPTIONS = (
    (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),  # Nagle's algorithm delays by 40 ms
    (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 1000 * KEEPALIVE_S),
    # Messages in the kernel's buffer are lost without being counted, so the buffer is small.
    (socket.SOL_SOCKET, socket.SO_SNDBUF, 16 * 1024),
)


class BrokerLostError(Exception):
    """The broker is absent, refuses the connection, does not answer, or has disconnected.

    A new attempt may succeed.
    """


@dataclass(frozen=True, slots=True)
class Outgoing:
    """One message to publish. Its properties are sent only with MQTT 5."""

    topic: str
    payload: bytes
    qos: int = 0
    retain: bool = False
    expiry_s: int | None = None
    """Time after which the broker drops the undelivered message, s."""
    response_topic: str | None = None
    correlation: bytes | None = None
    written: Callable[[], None] | None = field(default=None, compare=False)
    """Function called when the kernel has accepted the message; not used with QoS 1."""


@dataclass(frozen=True, slots=True)
class Incoming:
    """One received message."""

    topic: str
    payload: bytes
    retained: bool
    response_topic: str | None = None
    correlation: bytes | None = None


def stop_if_cancelled() -> None:
    """Raise a cancellation that ``wait_for`` in aiomqtt may have suppressed (Python 3.11).

    If a result arrives at the instant of the cancellation, ``wait_for`` returns the result. Call
    this function only in tasks without TaskGroup, because a task that contained a failed TaskGroup
    may appear cancelled from then on.
    """
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError


class MqttConnection:
    """A connection that is open for the duration of the ``async with`` block.

    If the block ends by cancellation, the connection publishes `farewell` and disconnects. Any
    other exception closes the socket at once, so that the broker publishes `will`.

    Parameters
    ----------
    settings
        Address, user and MQTT version.
    identifier
        Client id. With a fixed id, a new connection replaces the dead connection of an earlier
        process.
    will, farewell
        Messages for the end of the connection. The broker publishes `will` if the connection
        breaks. The client publishes `farewell` before it disconnects.
    longest_bytes
        Largest incoming packet, bytes. It is announced to the broker with MQTT 5, and enforced
        here.
    admit
        Function called with topic and retain flag of each incoming message before it is decoded,
        because decoding takes 100 µs. If it returns False, the message is dropped. Use it only for
        subscriptions with `live`.
    most_unread
        Largest number of unread messages. Further messages are dropped.

    Raises
    ------
    BrokerLostError
        The connection failed; the message names the broker and the operation. Any method can raise
        this error.
    """

    def __init__(
        self,
        settings: MqttSettings,
        identifier: str | None = None,
        *,
        will: Outgoing | None = None,
        farewell: Outgoing | None = None,
        longest_bytes: int = LONGEST_PACKET_BYTES,
        admit: Callable[[str, bool], bool] | None = None,
        most_unread: int = _UNREAD_CAPACITY,
    ) -> None:
        self._settings, self._identifier = settings, identifier
        self._will, self._farewell = will, farewell
        self._longest_bytes, self._admit, self._most_unread = longest_bytes, admit, most_unread
        self._modern = settings.version == "5"
        self._cached: dict[int | None, Any] = {}
        self._paho_log = PahoLog()

    async def __aenter__(self) -> Self:
        self._client = await self._new_client()
        task = asyncio.current_task()
        asked_before = task.cancelling() if task else 0  # number of earlier cancellation requests
        try:
            await self._client.__aenter__()
            if task and task.cancelling() > asked_before:
                stop_if_cancelled()
        except aiomqtt.MqttError as error:
            self._client.abandon()
            why = f"{refusal_fault(error)}{self._remedy(error)}"
            raise BrokerLostError(f"{self._address()}: {why}") from error
        except BaseException:
            self._client.abandon()
            raise
        return self

    @property
    def taken_over(self) -> bool:
        """Whether the broker ended the connection because another client uses the same id."""
        return self._client.taken_over

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        client = self._client
        try:
            if kind is not None and not issubclass(kind, asyncio.CancelledError):
                return
            # Publish the farewell and disconnect, each with a time limit. The broker then discards
            # the will.
            client.timeout = GOODBYE_S
            with contextlib.suppress(aiomqtt.MqttError, OSError):
                if self._farewell is not None:
                    await self._publish(self._farewell)
                await client.__aexit__(None, None, None)
        finally:
            client.abandon()

    @property
    def oversized(self) -> int:
        """Number of incoming packets that were dropped because of their size."""
        return self._client.oversized

    async def publish(self, message: Outgoing) -> None:
        """Publish a message; return when the broker (QoS 1) or the kernel (QoS 0) accepted it."""
        with self._session_errors(f"{message.topic}: "):
            await self._publish(message)

    async def _publish(self, message: Outgoing) -> None:
        await self._client.publish(
            message.topic,
            message.payload,
            message.qos,
            message.retain,
            self._properties(message) if self._modern else None,
        )

    async def send(self, message: Outgoing, accepted: Callable[[str | None], None]) -> None:
        """Send a message in the order of the calls; return without waiting for its acknowledgement.

        The method waits while `WINDOW` messages are unacknowledged, or fewer if the broker allows
        fewer. If an acknowledgement does not arrive within `ANSWER_S`, `messages` raises the error.

        Parameters
        ----------
        message
            Message to send.
        accepted
            Function called when the broker (QoS 1) or the kernel (QoS 0) has accepted the message.
            Its argument is the broker's reason for refusing the message, or None. Brokers state a
            reason only with MQTT 5 and QoS 1. The function is not called if the connection ends
            first.
        """
        properties = self._properties(message) if self._modern else None
        with self._session_errors(f"{message.topic}: "):
            await self._client.send(message, properties, accepted)

    async def subscribe(self, topics: Sequence[str], *, live: bool = False) -> list[str]:
        """Subscribe, and return the topics that the broker refused.

        With MQTT 5, a message that was sent with the retain flag arrives with this flag, even if it
        is new.

        Parameters
        ----------
        topics
            Topics or patterns.
        live
            True selects QoS 0 and, with MQTT 5, no stored messages. False selects QoS 1 with stored
            messages.
        """
        qos = 0 if live else 1
        handling = _NOT_STORED if live else SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE
        options = SubscribeOptions(qos=qos, retainAsPublished=True, retainHandling=handling)
        asked: list[Any] = [(topic, options if self._modern else qos) for topic in topics]
        with self._session_errors("cannot subscribe: "):
            codes = await self._client.subscribe(asked, timeout=SUBSCRIBED_S)
        values = [code if isinstance(code, int) else int(code.value) for code in codes]
        return [topic for topic, value in zip(topics, values, strict=False) if value >= _REFUSED]

    async def unsubscribe(self, topic: str) -> None:
        """Unsubscribe from one topic."""
        with self._session_errors("cannot unsubscribe: "):
            await self._client.unsubscribe(topic)

    @contextlib.contextmanager
    def _session_errors(self, operation: str) -> Iterator[None]:
        """Convert the errors of one exchange with the broker to `BrokerLostError`."""
        try:
            yield
        except (aiomqtt.MqttError, ValueError) as error:
            why = session_fault(error)
            raise BrokerLostError(f"{self._address()}: {operation}{why}") from error
        stop_if_cancelled()

    async def messages(self) -> AsyncIterator[Incoming]:
        """Yield incoming messages."""
        arriving = self._client.messages
        while True:
            try:
                message = await anext(arriving)
            except (aiomqtt.MqttError, OSError) as error:
                cause = error.__cause__ if isinstance(error, aiomqtt.MqttError) else None
                why = broker_fault(cause or error)
                raise BrokerLostError(f"{self._address()}: {why}") from error
            stop_if_cancelled()
            yield Incoming(
                message.topic.value,
                bytes(message.payload),
                retained=bool(message.retain),
                response_topic=getattr(message.properties, "ResponseTopic", None),
                correlation=getattr(message.properties, "CorrelationData", None),
            )

    # --- creation of the client --------------------------------------------------------------

    async def _new_client(self) -> _Client:
        settings, will = self._settings, self._will
        context = None
        if settings.tls is not None:
            try:  # in a thread, because reading the certificates takes tens of ms
                context = await asyncio.to_thread(tls_context, settings.tls)
            except TlsFilesError as fault:
                raise BrokerLostError(f"{self._address()}: [mqtt.tls]: {fault}") from fault

        last = will and aiomqtt.Will(will.topic, will.payload, will.qos, will.retain)
        limit: Any = None
        if self._modern:
            limit = _Properties(PacketTypes.CONNECT)
            limit.MaximumPacketSize = self._longest_bytes
        version = aiomqtt.ProtocolVersion.V5 if self._modern else aiomqtt.ProtocolVersion.V311
        return _Client(
            settings.host,
            settings.tcp_port,
            username=settings.username,
            password=password_of(settings),
            identifier=self._identifier,
            protocol=version,
            will=last,
            clean_session=None if self._modern else True,
            timeout=ANSWER_S,
            keepalive=KEEPALIVE_S,
            max_queued_incoming_messages=self._most_unread,
            tls_context=context,
            logger=self._paho_log,
            properties=limit,
            longest_bytes=self._longest_bytes,
            admit=self._admit,
        )

    def _address(self) -> str:
        return f"broker {self._settings.host}:{self._settings.tcp_port}"

    def _remedy(self, error: Exception) -> str:
        cause = self._paho_log.last or error.__cause__ or error.__context__
        if remedy := tls_remedy(cause, self._settings, established=self._client.opened):
            return remedy
        if self._modern and ("timed out" in str(error) or _CLOSED_EARLY in str(error)):
            return (
                " (no answer to MQTT 5; if the broker is older or serves MQTT 5 on another port, "
                'set version = "3.1.1" or that port in [mqtt])'
            )
        return ""

    def _properties(self, message: Outgoing) -> Any:
        plain = message.response_topic is None and message.correlation is None
        if plain and (cached := self._cached.get(message.expiry_s)) is not None:
            return cached  # building properties takes 40 µs
        made: Any = _Properties(PacketTypes.PUBLISH)
        made.ContentType = "application/json"
        made.UserProperty = ("v", str(PAYLOAD_VERSION))
        if message.expiry_s is not None:
            made.MessageExpiryInterval = message.expiry_s
        if message.response_topic is not None:
            made.ResponseTopic = message.response_topic
        if message.correlation is not None:
            made.CorrelationData = message.correlation
        if plain:
            self._cached[message.expiry_s] = made
        return made


class _Client(aiomqtt.Client):
    """Client of aiomqtt with a limit on incoming packets and immediate detection of failures.

    The client can be abandoned while it connects. It fails at once if the connection breaks during
    the handshake. It can send several messages before the first of them is acknowledged.
    """

    _abandoned = False
    taken_over = False

    def __init__(
        self,
        *arguments: Any,
        longest_bytes: int,
        admit: Callable[[str, bool], bool] | None,
        **options: Any,
    ) -> None:
        super().__init__(*arguments, **options)
        self._encoder = PublishEncoder()
        self._unacknowledged: dict[int, tuple[float, Callable[[str | None], None]]] = {}
        """Time limit (s) and callback of each unacknowledged message, by id, oldest first."""
        self._acknowledged = asyncio.Event()
        self._limit_timer: asyncio.TimerHandle | None = None
        self._window = WINDOW
        self._longest_bytes, self._admit = longest_bytes, admit
        self._limited: PacketLimitSocket | None = None
        self._disconnected.add_done_callback(self._fail_handshake)

    @property
    def opened(self) -> bool:
        """Whether a socket was opened and its TLS handshake, if any, completed."""
        return self._limited is not None

    @property
    def oversized(self) -> int:
        """Number of incoming packets larger than the size limit."""
        return 0 if self._limited is None else self._limited.oversized

    async def __aenter__(self) -> Self:  # type: ignore[explicit-override]  # Python 3.12's
        """Connect, and fail if the connection ended at the moment of its acceptance.

        aiomqtt ignores such an end, and would wait for messages without limit.
        """
        ended = self._disconnected
        await super().__aenter__()
        if ended.done():
            raise aiomqtt.MqttError(_CLOSED_EARLY)
        return self

    def abandon(self) -> None:
        """Close the socket at once.

        Otherwise the socket of a failed attempt stays open for seconds.
        """
        self._abandoned = True
        if self._limit_timer is not None:
            self._limit_timer.cancel()
        if self._misc_task is not None:
            self._misc_task.cancel()
        opened: Any = self._client.socket()
        if opened is not None and opened.fileno() >= 0:
            self._loop.remove_reader(opened.fileno())
            self._loop.remove_writer(opened.fileno())
            opened.close()

    def _on_socket_open(  # type: ignore[explicit-override]  # typing.override is Python 3.12's
        self, client: Any, userdata: Any, sock: Any
    ) -> None:
        """Wrap the new socket; runs in the connecting thread, possibly after `abandon`."""
        if self._abandoned:
            sock.close()
            return
        if isinstance(sock, socket.socket):
            for option in _SOCKET_OPTIONS:  # aiomqtt sets options on plain sockets only
                sock.setsockopt(*option)
        self._limited = PacketLimitSocket(sock, self._longest_bytes, self._admit)
        client._sock = self._limited  # noqa: SLF001 - paho has no public setter
        super()._on_socket_open(client, userdata, sock)

    def _on_disconnect(  # type: ignore[explicit-override]  # typing.override is Python 3.12's
        self, client: Any, userdata: Any, flags: Any, reason_code: Any, properties: Any = None
    ) -> None:
        """Store the reason of a disconnect, which the error of a failing task may lack.

        A connection that ends before its acceptance fails at once, without the timeout of aiomqtt.
        """
        code = getattr(reason_code, "value", None)
        self.taken_over |= code == _TAKEN_OVER
        old = self._client.protocol != aiomqtt.ProtocolVersion.V5.value
        if code == _PROTOCOL_ERROR and old and not self._connected.done():
            self._connected.set_exception(aiomqtt.MqttError(VERSION_REFUSED))
        self._fail_handshake()
        super()._on_disconnect(client, userdata, flags, reason_code, properties)

    def _fail_handshake(self, ended: asyncio.Future[None] | None = None) -> None:
        if ended is not None and not ended.cancelled():
            ended.exception()  # mark as retrieved: aiomqtt reads it only while awaiting messages
        if not self._connected.done():
            self._connected.set_exception(aiomqtt.MqttError(_CLOSED_EARLY))

    def _on_socket_unregister_write(  # type: ignore[explicit-override]  # Python 3.12's
        self, client: Any, userdata: Any, sock: Any
    ) -> None:
        """Make the kernel acknowledge the next data at once; paho calls this method after sending.

        After a transmission such as a ping, the kernel delays acknowledgements by up to 40 ms.
        During this time a broker with Nagle's algorithm delays its next messages (RFC 1122, 4.2.3.2
        and 4.2.3.4).
        """
        super()._on_socket_unregister_write(client, userdata, sock)
        with contextlib.suppress(OSError):  # closed, or not supported
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)

    def _on_connect(  # type: ignore[explicit-override]  # typing.override is Python 3.12's
        self, client: Any, userdata: Any, flags: Any, reason_code: Any, properties: Any = None
    ) -> None:
        """Store the number of unacknowledged messages that the broker allows."""
        self._window = min(WINDOW, getattr(properties, "ReceiveMaximum", WINDOW))
        super()._on_connect(client, userdata, flags, reason_code, properties)

    async def send(
        self, message: Outgoing, properties: Any, accepted: Callable[[str | None], None]
    ) -> None:
        """Send a message as soon as the limit of unacknowledged messages permits it."""
        while len(self._unacknowledged) >= self._window:
            self._acknowledged.clear()
            await self._acknowledged.wait()

        if not message.qos and self._write_at_once(message, properties, accepted):
            return
        sent = self._client.publish(
            message.topic, message.payload, message.qos, message.retain, properties
        )
        if sent.rc:
            raise aiomqtt.MqttCodeError(sent.rc)
        self._await_acceptance(sent.mid, accepted)

    def _write_at_once(
        self, message: Outgoing, properties: Any, accepted: Callable[[str | None], None]
    ) -> bool:
        """Write a message with QoS 0 to the socket; return False if the library must queue it.

        The library would wake the event loop by sending a byte to itself and wait until the socket
        is writable. It would also build an acknowledgement, which QoS 0 does not have.
        """
        client: Any = self._client
        opened = client.socket()
        if opened is None or client.want_write():
            return False  # closed, or other messages are sent first
        packet = self._encoder.encode(message.topic, message.payload, properties, message.retain)
        try:
            written = opened.send(packet)
        except OSError:  # full or broken: the library gets the same error and reports it
            return False
        if written == len(packet):
            accepted(None)
            return True

        # The library writes the rest of this message before any other message.
        sent = MQTTMessageInfo(client._mid_generate())  # noqa: SLF001 - it has no public equivalent
        self._await_acceptance(sent.mid, accepted)
        client._packet_queue(PUBLISH, packet[written:], sent.mid, 0, sent)  # noqa: SLF001 - no public equivalent
        return True

    def _await_acceptance(self, mid: int, accepted: Callable[[str | None], None]) -> None:
        """Expect the acceptance of a message within `ANSWER_S`."""
        self._unacknowledged[mid] = (self._loop.time() + ANSWER_S, accepted)
        if self._limit_timer is None:
            self._limit_timer = self._loop.call_later(ANSWER_S, self._check_limit)

    def _check_limit(self) -> None:
        """End the connection if the oldest message has waited too long, or check again later.

        All messages share one timer, because starting a timer takes longer than sending a message.
        """
        self._limit_timer = None
        if not self._unacknowledged:
            return
        limit_s, _ = next(iter(self._unacknowledged.values()))
        if self._loop.time() < limit_s:
            self._limit_timer = self._loop.call_at(limit_s, self._check_limit)
        elif not self._disconnected.done():
            self._disconnected.set_exception(aiomqtt.MqttError(NO_ANSWER))

    def _on_publish(  # type: ignore[explicit-override]  # typing.override is Python 3.12's
        self, client: Any, userdata: Any, mid: int, reason_code: Any, properties: Any
    ) -> None:
        if (message := self._unacknowledged.pop(mid, None)) is not None:
            self._acknowledged.set()
            message[1](str(reason_code) if reason_code.is_failure else None)
        super()._on_publish(client, userdata, mid, reason_code, properties)


class DisconnectErrorFilter:
    """Exception handler of the event loop that drops two harmless errors of aiomqtt.

    At a disconnect, aiomqtt leaves an ``MqttError`` in a future that no task awaits. In addition, a
    callback on a closed socket fails with a bad file descriptor. These two errors are counted; all
    other errors are handled as usual.
    """

    def __init__(self) -> None:
        self.dropped = 0

    def __call__(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Count or report one error of the event loop."""
        error, message = context.get("exception"), str(context.get("message", ""))
        late = isinstance(error, aiomqtt.MqttError) and "never retrieved" in message

        # The callback belongs to aiomqtt, or one of its arguments does.
        handle = context.get("handle")
        functions = (getattr(handle, "_callback", None), *(getattr(handle, "_args", None) or ()))
        ours = any(str(getattr(f, "__module__", "")).startswith("aiomqtt") for f in functions)
        closed = isinstance(error, OSError) and error.errno == errno.EBADF and ours
        if late or closed:
            self.dropped += 1
        else:
            loop.default_exception_handler(context)
