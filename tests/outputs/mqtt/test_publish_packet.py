"""Messages at QoS 0 that are written directly to the socket: bytes, and a full socket."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from paho.mqtt.client import Client, MQTTv5, MQTTv311
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs.mqtt import DisconnectErrorFilter
from jointfit_daemon.outputs.mqtt._connection import MqttConnection, Outgoing
from jointfit_daemon.outputs.mqtt._publish_packet import PublishEncoder

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

_Properties: Any = Properties  # the constructor is not annotated
CONNACK = b"\x20\x03\x00\x00\x00"
LARGE = 200_000
"""Number of bytes that exceeds all socket buffers together."""


class PacketCollector(Client):
    """A client of paho that stores packets instead of sending them."""

    def __init__(self, protocol: int) -> None:
        super().__init__(CallbackAPIVersion.VERSION2, protocol=protocol)  # type: ignore[arg-type]
        self._sock: Any = object()  # any object, so that the client counts as connected
        self.packets: list[bytes] = []

    def _packet_queue(self, command: int, packet: Any, *rest: Any) -> Any:  # type: ignore[explicit-override]
        del command, rest
        self._sock = None  # so that the client closes no socket
        self.packets.append(bytes(packet))
        return 0


@given(
    st.text("abcäß/_-", min_size=1), st.binary(max_size=40), st.integers(0, 20_000), st.booleans()
)
@pytest.mark.parametrize("protocol", [MQTTv5, MQTTv311])
def test_packets_are_those_of_the_library(
    protocol: int, topic: str, start: bytes, zeros: int, retain: bool
) -> None:
    payload = start + bytes(zeros)
    properties = None
    if protocol == MQTTv5:
        properties = _Properties(PacketTypes.PUBLISH)
        properties.ContentType = "application/json"
        properties.UserProperty = ("v", "1")
        properties.MessageExpiryInterval = 2
    library = PacketCollector(protocol)
    library.publish(topic, payload, 0, retain, properties)
    encoder = PublishEncoder()
    assert library.packets == [encoder.encode(topic, payload, properties, retain)]
    assert library.packets == [encoder.encode(topic, payload, properties, retain)]


class SlowReader:
    """A broker that accepts a connection, and reads further data on request only."""

    def __init__(self) -> None:
        self.received = bytearray()
        self._reader: asyncio.StreamReader
        self.writer: asyncio.StreamWriter

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self.writer = reader, writer
        await reader.readexactly(2)
        writer.write(CONNACK)

    async def read_up_to(self, end: bytes) -> None:
        async with asyncio.timeout(5):
            while not self.received.endswith(end):
                self.received += await self._reader.read(65_536)


@contextlib.asynccontextmanager
async def connected() -> AsyncIterator[tuple[SlowReader, MqttConnection]]:
    asyncio.get_running_loop().set_exception_handler(DisconnectErrorFilter())
    broker = SlowReader()
    server = await asyncio.start_server(broker.serve, "127.0.0.1", 0, limit=1024)
    address = MqttSettings(host="127.0.0.1", port=server.sockets[0].getsockname()[1], base="b")
    connection = MqttConnection(address)
    async with server:
        await connection.__aenter__()
        try:
            yield broker, connection
        finally:
            await connection.__aexit__(ConnectionError, None, None)
            broker.writer.close()


async def test_messages_keep_their_order_and_bytes_when_the_socket_is_full() -> None:
    accepted: list[int] = []
    payloads = [bytes([number]) * size for number, size in enumerate((10, LARGE, 10, LARGE, 10))]
    async with connected() as (broker, connection):
        for number, payload in enumerate(payloads):
            message = Outgoing("b/pose", payload, expiry_s=2)
            await connection.send(message, lambda _, number=number: accepted.append(number))  # type: ignore[misc]
        assert accepted == [0]  # the second message did not fit, and all later messages wait

        await broker.read_up_to(payloads[-1])
    found, at = [], broker.received.index(b"b/pose") - 5
    for payload in payloads:
        at = broker.received.index(payload[:10], at)
        assert broker.received[at : at + len(payload)] == payload
        found.append(at)
        at += len(payload)
    assert found == sorted(found)


async def test_a_message_that_fits_is_accepted_without_the_event_loop() -> None:
    accepted: list[str | None] = []
    async with connected() as (broker, connection):
        sending = connection.send(Outgoing("b/pose", b"{}", expiry_s=2), accepted.append)
        with pytest.raises(StopIteration):
            sending.send(None)
        assert accepted == [None]
        await broker.read_up_to(b"{}")
