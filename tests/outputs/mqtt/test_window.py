"""Several messages are sent before the first is acknowledged: limit, refusals, order, loss."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from functools import partial
from typing import TYPE_CHECKING, Any

import aiomqtt
import pytest

from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs.mqtt import (
    BrokerLostError,
    DisconnectErrorFilter,
    MqttPublisher,
    Outbox,
)
from jointfit_daemon.outputs.mqtt._connection import WINDOW, MqttConnection, Outgoing

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from tests.broker_fixture import Broker

BASE = "jointfit/test"
PROTOCOLS = {"5": aiomqtt.ProtocolVersion.V5, "3.1.1": aiomqtt.ProtocolVersion.V311}
PUBLISH, NOT_AUTHORIZED = 0x30, 0x87


class AcknowledgingBroker:
    """An MQTT 5 broker that accepts one connection and acknowledges when the test asks it to.

    Parameters
    ----------
    receive_maximum
        Number of unacknowledged messages that the broker permits.
    """

    def __init__(self, receive_maximum: int) -> None:
        self.topics: dict[str, int] = {}
        """Topics of the messages received, with their message ids."""
        self._connack = b"\x20\x06\x00\x00\x03\x21" + receive_maximum.to_bytes(2)
        self._writer: asyncio.StreamWriter

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writer = writer
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            await self._packet(reader)
            writer.write(self._connack)
            while True:
                kind, body = await self._packet(reader)
                if kind & 0xF0 == PUBLISH:
                    end = 2 + int.from_bytes(body[:2])
                    self.topics[body[2:end].decode()] = int.from_bytes(body[end : end + 2])
        writer.close()

    def acknowledge(self, topic: str, reason: int = 0) -> None:
        self._writer.write(b"\x40\x03" + self.topics[topic].to_bytes(2) + bytes([reason]))

    @staticmethod
    async def _packet(reader: asyncio.StreamReader) -> tuple[int, bytes]:
        (kind,), length, shift = await reader.readexactly(1), 0, 0
        while True:
            (byte,) = await reader.readexactly(1)
            length |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return kind, await reader.readexactly(length)


@contextlib.asynccontextmanager
async def connected(
    receive_maximum: int,
) -> AsyncIterator[tuple[AcknowledgingBroker, MqttConnection]]:
    asyncio.get_running_loop().set_exception_handler(DisconnectErrorFilter())
    broker = AcknowledgingBroker(receive_maximum)
    server = await asyncio.start_server(broker.serve, "127.0.0.1", 0)
    address = MqttSettings(host="127.0.0.1", port=server.sockets[0].getsockname()[1], base=BASE)
    connection = MqttConnection(address)
    async with server:
        await connection.__aenter__()
        try:
            yield broker, connection
        finally:
            await connection.__aexit__(ConnectionError, None, None)


async def until(condition: Callable[[], bool], within_s: float = 5.0) -> None:
    async with asyncio.timeout(within_s):
        while not condition():
            await asyncio.sleep(0.005)


@pytest.mark.parametrize(("receive_maximum", "expected"), [(3, 3), (100, WINDOW)])
async def test_window_is_that_of_the_broker_if_it_is_smaller(
    receive_maximum: int, expected: int
) -> None:
    async with connected(receive_maximum) as (broker, connection):

        async def send() -> None:
            for number in range(expected + 2):
                await connection.send(Outgoing(str(number), b"", 1), lambda _: None)

        sending = asyncio.create_task(send())
        await until(lambda: len(broker.topics) == expected)
        await asyncio.sleep(0.05)
        assert len(broker.topics) == expected

        broker.acknowledge("1")  # messages may be acknowledged in any order
        await until(lambda: len(broker.topics) == expected + 1)
        assert not sending.done()
        broker.acknowledge("0")
        await sending


async def test_refusal_belongs_to_the_message_with_its_id() -> None:
    refusals: dict[str, str | None] = {}
    async with connected(10) as (broker, connection):
        for topic in "abc":
            await connection.send(Outgoing(topic, b"", 1), partial(refusals.__setitem__, topic))
        await until(lambda: len(broker.topics) == 3)
        broker.acknowledge("c")
        broker.acknowledge("b", NOT_AUTHORIZED)
        broker.acknowledge("a")
        await until(lambda: len(refusals) == 3)
    assert refusals == {"c": None, "b": "Not authorized", "a": None}


async def test_missing_acknowledgement_ends_the_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jointfit_daemon.outputs.mqtt._connection.ANSWER_S", 0.3)
    async with connected(10) as (broker, connection):
        for topic in "ab":
            await connection.send(Outgoing(topic, b"", 1), lambda _: None)
        await until(lambda: len(broker.topics) == 2)
        broker.acknowledge("a")
        with pytest.raises(BrokerLostError, match="does not answer in time"):
            async with asyncio.timeout(3):
                await anext(connection.messages())


def lose_connection(link: MqttPublisher) -> None:
    """Close the socket of the publisher, as a failing network does."""
    connection: Any = link._connection
    connection._client._client.socket().shutdown(socket.SHUT_RDWR)


@pytest.mark.parametrize("version", ["5", "3.1.1"])
async def test_messages_of_a_topic_arrive_in_order_across_losses_of_the_connection(
    broker: Broker, version: str
) -> None:
    asyncio.get_running_loop().set_exception_handler(DisconnectErrorFilter())
    port = broker.port_of(version)
    settings = MqttSettings(host="127.0.0.1", port=port, base=BASE, version=version)  # type: ignore[arg-type]
    outbox, received = Outbox(f"{BASE}/bridge/state"), list[int]()
    link = MqttPublisher(settings, outbox, lambda _: None)
    async with aiomqtt.Client("127.0.0.1", port, protocol=PROTOCOLS[version]) as watcher:
        await watcher.subscribe(f"{BASE}/bridge/event", qos=1)
        task = asyncio.create_task(link.run())
        for number in range(200):
            outbox.event(f"{BASE}/bridge/event", b"%d" % number)
        await until(lambda: link.sent > 50)
        lose_connection(link)
        async with asyncio.timeout(5):
            async for message in watcher.messages:
                received.append(int(bytes(message.payload)))
                if received[-1] == 199:
                    break
        task.cancel()
        await asyncio.wait([task])

    # Messages without an acknowledgement are repeated. Without the repetitions, the received
    # messages are complete and in order.
    assert link.connects == 2
    assert list(dict.fromkeys(received)) == list(range(200))
    assert len(received) <= 200 + WINDOW
