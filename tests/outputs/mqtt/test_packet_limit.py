"""Input from a broker and its clients is limited in memory and time."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import time
from typing import TYPE_CHECKING

import aiomqtt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.outputs.mqtt import BrokerLostError, Incoming
from jointfit_daemon.outputs.mqtt._connection import MqttConnection, Outgoing
from jointfit_daemon.outputs.mqtt._packet_limit import PacketLimitSocket
from jointfit_daemon.outputs.mqtt._publisher import REQUEST_BURST, REQUEST_RATE_HZ
from tests.outputs.mqtt.test_connection import BASE, LIFE, Link, running, settings, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from tests.broker_fixture import Broker

REQUEST = f"{BASE}/bridge/request/calibrate"
LIMIT = 300


def packet(length: int, first: int = 0x30) -> bytes:
    """Return an MQTT packet with `length` bytes after its header."""
    header, left = bytearray([first]), length
    while True:
        left, digit = divmod(left, 128)
        header.append(digit | (0x80 if left else 0))
        if not left:
            return bytes(header) + bytes(length)


def message(topic: str, payload: bytes, *, retained: bool) -> bytes:
    """Return an MQTT 3.1.1 PUBLISH packet at QoS 0."""
    body = struct.pack(">H", len(topic)) + topic.encode() + payload
    return packet(len(body), 0x31 if retained else 0x30)[: -len(body)] + body


def passed_on(sent: bytes, chunk: int, admit: Callable[[str, bool], bool] | None = None) -> bytes:
    """Return what a reader receives that, like paho, reads single bytes and longer pieces."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.setblocking(False)
        limited, found = PacketLimitSocket(ours, LIMIT, admit), b""
        for start in range(0, len(sent), chunk):
            theirs.sendall(sent[start : start + chunk])
            idle = 0
            while idle < 9:  # one call drops only some of the packets
                try:
                    found += limited.recv(1 if len(found) % 2 else 1000)
                except BlockingIOError:
                    idle += 1
        return found


@given(st.lists(st.integers(0, 2 * LIMIT), max_size=8), st.integers(1, 5000))
def test_exactly_the_packets_within_the_limit_are_passed_on(lengths: list[int], chunk: int) -> None:
    sent = b"".join(packet(length) for length in lengths)
    kept = b"".join(packet(length) for length in lengths if length <= LIMIT)
    assert passed_on(sent, chunk) == kept


@given(
    st.lists(
        st.tuples(st.sampled_from(["", "a", "a/b", "c" * 200]), st.integers(0, 400), st.booleans())
    ),
    st.integers(1, 5000),
)
def test_exactly_the_admitted_messages_are_passed_on(
    sent: list[tuple[str, int, bool]], chunk: int
) -> None:
    asked: list[tuple[str, bool]] = []

    def admit(topic: str, retained: bool) -> bool:
        asked.append((topic, retained))
        return topic.startswith("a") and not retained

    other = packet(7, 0xD0)  # not a PUBLISH packet, so it is always passed on
    arriving = passed = b""
    within: list[tuple[str, bool]] = []
    for topic, length, retained in sent:
        one = message(topic, bytes(length), retained=retained)
        arriving += one + other
        if 2 + len(topic) + length <= LIMIT:
            within.append((topic, retained))
            passed += one if topic.startswith("a") and not retained else b""
        passed += other
    assert passed_on(arriving, chunk, admit) == passed
    assert asked == within


@pytest.mark.parametrize("version", ["5", "3.1.1"])
async def test_a_message_over_the_limit_is_dropped_and_the_next_one_read(
    broker: Broker, version: str
) -> None:
    port = broker.port_of(version)
    async with running(Link(port, version=version)) as link:
        await until(lambda: bool(link.publisher.health().confirmed))
        async with MqttConnection(settings(port, version=version)) as attacker:
            await attacker.publish(Outgoing(REQUEST, bytes(900_000), 1))
            await attacker.publish(Outgoing(REQUEST, b"{}", 1))
            await until(lambda: bool(link.requests))
        assert [message.payload for message in link.requests] == [b"{}"]
        assert link.publisher.connects == 1


async def test_packet_limit_is_announced_to_mosquitto(mosquitto: Broker) -> None:
    async with running(Link(mosquitto.port)) as link:
        await until(lambda: bool(link.publisher.health().confirmed))
        async with MqttConnection(settings(mosquitto.port)) as attacker:
            await attacker.publish(Outgoing(REQUEST, bytes(900_000), 1))
            await attacker.publish(Outgoing(REQUEST, b"{}", 1))
            await until(lambda: bool(link.requests))
        assert link.publisher.health().ignored_requests == 0


@pytest.mark.parametrize("version", ["5", "3.1.1"])
@pytest.mark.timeout(120)
async def test_ten_thousand_stored_messages_do_not_prevent_connecting(
    mosquitto: Broker, version: str
) -> None:
    async with aiomqtt.Client("127.0.0.1", mosquitto.port) as attacker:
        for number in range(10_000):
            await attacker.publish(f"{BASE}/bridge/request/r{number}", b"{}", retain=True)
        await attacker.publish(f"{BASE}/x", b"", qos=1)
    async with running(Link(mosquitto.port, version=version)) as link:
        await until(lambda: bool(link.publisher.health().confirmed), 30)
        assert link.publisher.connects == 1
        if version == "3.1.1":  # with MQTT 5, the broker sends no retained requests
            await until(lambda: link.publisher.ignored_requests > 0)
    assert link.requests == []


async def test_requests_are_passed_on_at_a_limited_rate(
    broker: Broker, caplog: pytest.LogCaptureFixture
) -> None:
    async with running(Link(broker.port)) as link:
        await until(lambda: bool(link.publisher.health().confirmed))
        began = time.monotonic()
        async with MqttConnection(settings(broker.port)) as attacker:
            for _ in range(500):
                await attacker.publish(Outgoing(REQUEST, b"[["))
            await until(lambda: link.publisher.ignored_requests > 100)
        allowed = REQUEST_BURST + REQUEST_RATE_HZ * (time.monotonic() - began)
        assert REQUEST_BURST <= len(link.requests) <= allowed + 1
    assert caplog.text.count("ignored a request") <= 1 + (time.monotonic() - began) / 10


async def test_requests_beyond_the_rate_are_dropped_before_they_are_decoded(
    broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded = 0
    messages = MqttConnection.messages

    async def counted(connection: MqttConnection) -> AsyncIterator[Incoming]:
        nonlocal decoded
        async for found in messages(connection):
            decoded += found.topic == REQUEST
            yield found

    monkeypatch.setattr(MqttConnection, "messages", counted)
    async with running(Link(broker.port)) as link:
        await until(lambda: bool(link.publisher.health().confirmed))
        async with MqttConnection(settings(broker.port)) as attacker:
            for number in range(500):
                await attacker.publish(Outgoing(REQUEST, b"[[", qos=number % 2))
        await until(lambda: link.publisher.ignored_requests + len(link.requests) == 500)
        assert decoded == len(link.requests)
        assert link.publisher.connects == 1


# --- refusals ---------------------------------------------------------------------------------


@pytest.mark.parametrize("version", ["5", "3.1.1"])
async def test_denied_pose_is_reported(
    tmp_path: Path,
    start_mosquitto: Callable[[str], Broker],
    version: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr("jointfit_daemon.outputs.mqtt._publisher.ECHO_S", 0.5)
    rules = tmp_path / "acl"
    rules.write_text(f"topic readwrite {BASE}/#\ntopic deny {BASE}/pose\n")
    rules.chmod(0o600)
    broker = start_mosquitto(f"acl_file {rules}\n")
    async with running(Link(broker.port, version=version)) as link, poses(link):
        await until(lambda: bool(link.publisher.health().denied))
        assert link.publisher.health().denied == ["pose"]
        assert link.publisher.health().confirmed is False
    assert f"{BASE}/pose" in caplog.text


@pytest.mark.parametrize("version", ["5", "3.1.1"])
async def test_an_allowed_pose_is_confirmed(broker: Broker, version: str) -> None:
    port = broker.port_of(version)
    async with running(Link(port, version=version)) as link, poses(link):
        await until(lambda: link.publisher.sent > 10)
        await until(lambda: bool(link.publisher.health().confirmed))
        assert link.publisher.health().denied == []


async def test_a_response_topic_that_the_broker_denies_costs_one_entry(
    tmp_path: Path, start_mosquitto: Callable[[str], Broker]
) -> None:
    rules = tmp_path / "acl"
    rules.write_text(f"topic readwrite {LIFE}\ntopic readwrite {BASE}/bridge/request/+\n")
    rules.chmod(0o600)
    broker = start_mosquitto(f"acl_file {rules}\n")
    async with running(Link(broker.port)) as link:
        await until(lambda: link.publisher.connected)
        for number in range(20):
            link.outbox.event(f"{BASE}/bridge/response/calibrate/{number}", b"{}")
        await until(lambda: link.publisher.sent >= 21)
        assert link.publisher.health().denied == ["bridge/response/#"]


@contextlib.asynccontextmanager
async def poses(link: Link) -> AsyncIterator[None]:
    """Put 100 poses per second into the outbox."""

    async def put() -> None:
        while True:
            link.outbox.stream(f"{BASE}/pose", b"{}")
            await asyncio.sleep(0.01)

    task = asyncio.create_task(put(), name="poses")
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait([task])


# --- the handshake ------------------------------------------------------------------------------


@contextlib.asynccontextmanager
async def broken_broker(answer: bytes, *, reset: bool) -> AsyncIterator[tuple[int, list[float]]]:
    """Run a server that answers CONNECT with `answer` and closes the connection.

    Yield the port of the server, and the times of the connections, s. With `reset`, the server
    resets each connection.
    """
    tries: list[float] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        tries.append(time.monotonic())
        await reader.read(1)
        writer.write(answer)
        if reset:
            opened = writer.get_extra_info("socket")
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server:
        yield server.sockets[0].getsockname()[1], tries


@pytest.mark.parametrize("reset", [True, False])
@pytest.mark.parametrize("version", ["5", "3.1.1"])
async def test_broker_that_closes_during_the_handshake_is_retried_at_once(
    version: str, *, reset: bool
) -> None:
    async with broken_broker(b"", reset=reset) as (port, tries):
        async with running(Link(port, version=version)):
            await until(lambda: len(tries) >= 3, 2.5)  # an attempt with a time-out would take 3 s
        # The waits increase: 0.05 s, 0.1 s, 0.2 s, 0.4 s, then 0.6 s. Each wait is at least half of
        # this value.
        assert len(tries) <= 8


ACCEPTED = b"\x20\x03\x00\x00\x00"
publishes = st.binary(max_size=60).map(lambda body: bytes([0x30, len(body)]) + body)


async def read_all(port: int) -> None:
    async with MqttConnection(settings(port)) as connection:
        async for _ in connection.messages():
            pass


@given(answer=st.binary(max_size=40) | (st.binary(max_size=40) | publishes).map(ACCEPTED.__add__))
async def test_invalid_bytes_from_a_broker_raise_broker_lost_error(answer: bytes) -> None:
    async with broken_broker(answer, reset=False) as (port, _):
        with pytest.raises(BrokerLostError):
            await asyncio.wait_for(read_all(port), 2.5)
