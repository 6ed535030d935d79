"""MQTT client of the command-line tools: receives the topics of a daemon and sends requests.

The client does not reconnect: a tool that loses its broker reports the loss and ends.
"""

from __future__ import annotations

import asyncio
import uuid
from collections import deque
from typing import TYPE_CHECKING, Any, Self

import orjson

from jointfit_daemon.outputs import topics
from jointfit_daemon.outputs.mqtt._connection import (
    BrokerLostError,
    Incoming,
    MqttConnection,
    Outgoing,
)
from jointfit_daemon.outputs.mqtt._secret_files import RequestKeyError, request_key_of
from jointfit_daemon.outputs.mqtt._signature import sign_request

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping
    from types import TracebackType

    from jointfit_daemon.config import MqttSettings

_UNREAD_CAPACITY = 2000
"""Number of messages that are stored for a slow reader, equal to 20 s of poses at 100 Hz."""
_LONGEST_BYTES = 1024 * 1024
"""Largest incoming packet, bytes. The quality report of a calibration takes a tenth of this
size."""
_EXPIRY_S = 30
"""Time after which the broker drops an undelivered request, s. A late request must not be
executed."""


class NoAnswerError(Exception):
    """No daemon answered the request within the time limit."""


class MqttClient:
    """A connection to the broker of a rig, open for the duration of the ``async with`` block.

    Parameters
    ----------
    settings
        Table ``[mqtt]`` of the rig; ``settings.base`` selects the daemon.

    Raises
    ------
    BrokerLostError
        The broker is absent or disconnected. Entering the block, any method and the iteration over
        the messages can raise this error.
    """

    def __init__(self, settings: MqttSettings) -> None:
        self.base = settings.base
        self.dropped = 0
        """Number of messages dropped because the reader was too slow."""
        self._settings = settings
        # One read of the socket may receive many messages before the task that empties the queue
        # runs.
        self._connection = MqttConnection(
            settings, longest_bytes=_LONGEST_BYTES, most_unread=_UNREAD_CAPACITY
        )
        self._own = uuid.uuid4().hex
        """Last level of the response topics of this client (MQTT 5)."""
        self._unread: deque[Incoming] = deque()
        self._arrived = asyncio.Event()
        self._lost: BrokerLostError | None = None
        self._waiting: dict[str, asyncio.Future[dict[str, Any]]] = {}

    async def __aenter__(self) -> Self:
        await self._connection.__aenter__()
        self._reader = asyncio.create_task(self._read(), name="mqtt client")
        answers = topics.RESPONSE.name(self.base, "+")
        await self._connection.subscribe([answers, f"{answers}/{self._own}"])
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._reader.cancel()
        await asyncio.wait([self._reader])
        await self._connection.__aexit__(None, None, None)

    async def subscribe(self, *names: str) -> None:
        """Subscribe to topics given relative to the base, such as ``device/+/availability``."""
        await self._connection.subscribe([f"{self.base}/{name}" for name in names])

    async def messages(self) -> AsyncIterator[tuple[str, Any]]:
        """Yield the relative topic and the decoded payload of every message except responses."""
        while True:
            while self._unread:
                message = self._unread.popleft()
                yield message.topic.removeprefix(f"{self.base}/"), _decode_json(message.payload)
            if self._lost is not None:
                raise self._lost
            self._arrived.clear()
            await self._arrived.wait()

    async def request(
        self, command: str, arguments: Mapping[str, object], *, timeout_s: float = 5.0
    ) -> dict[str, Any]:
        """Send a request and return its answer: ``status``, ``data`` and, on refusal, ``error``.

        The request is signed if the rig configures a key.

        Raises
        ------
        NoAnswerError
            No answer arrived within `timeout_s`, or the signing key cannot be read.
        """
        transaction = uuid.uuid4().hex
        answer: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
        self._waiting[transaction] = answer
        topic = topics.REQUEST.name(self.base, command)
        try:
            request: dict[str, object] = {**arguments, "transaction": transaction}
            if (key := request_key_of(self._settings)) is not None:
                request = sign_request(key, topic, request)
            if self._lost is not None:
                raise self._lost
            await self._connection.publish(
                Outgoing(
                    topic,
                    orjson.dumps(request),
                    1,
                    expiry_s=_EXPIRY_S,
                    response_topic=f"{topics.RESPONSE.name(self.base, command)}/{self._own}",
                )
            )
            async with asyncio.timeout(timeout_s):
                return await answer
        except RequestKeyError as missing:
            raise NoAnswerError(f"cannot sign the request: {missing}") from missing
        except TimeoutError as error:
            text = (
                f"no daemon answers on {topic}: check that jointfitd is running with this base, and"
                " that no other client sends more than ten requests per second (they are ignored)"
            )
            raise NoAnswerError(text) from error
        finally:
            del self._waiting[transaction]
            answer.cancel()

    async def _read(self) -> None:
        try:
            async for message in self._connection.messages():
                if message.topic.startswith(topics.RESPONSE.name(self.base)):
                    reply = _decode_json(message.payload)
                    key = reply.get("transaction") if isinstance(reply, dict) else None
                    answer = self._waiting.get(key) if isinstance(key, str) else None
                    if answer is not None and not answer.done():
                        answer.set_result(reply)
                    continue

                if len(self._unread) >= _UNREAD_CAPACITY:
                    self._unread.popleft()
                    self.dropped += 1
                self._unread.append(message)
                self._arrived.set()
        except BrokerLostError as error:
            self._lost = error
            for answer in self._waiting.values():
                if not answer.done():
                    answer.set_exception(error)
            self._arrived.set()


def _decode_json(payload: bytes) -> Any:
    """Return the JSON value of `payload`; None if it is not JSON."""
    try:
        return orjson.loads(payload)
    except orjson.JSONDecodeError:
        return None
