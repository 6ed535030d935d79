"""Connection to a real broker: losses, restarts, access rights and retained requests."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import time
from typing import TYPE_CHECKING, Any, Literal

import aiomqtt
import orjson
import pytest
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs.mqtt import (
    BrokerLostError,
    DisconnectErrorFilter,
    Incoming,
    MqttClient,
    MqttPublisher,
    NoAnswerError,
    Outbox,
)
from jointfit_daemon.outputs.mqtt._connection import MqttConnection, Outgoing
from jointfit_daemon.outputs.mqtt._error_messages import broker_fault, session_fault
from jointfit_daemon.outputs.topics import OFFLINE, ONLINE
from tests.broker_fixture import free_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from tests.broker_fixture import Broker

BASE = "jointfit/test"
LIFE = f"{BASE}/bridge/state"


def settings(port: int, **more: Any) -> MqttSettings:
    return MqttSettings(host="127.0.0.1", port=port, base=BASE, **more)


class Link:
    """A running publisher, and all requests that it passed on."""

    def __init__(self, port: int, **more: Any) -> None:
        self.outbox = Outbox(LIFE)
        self.requests: list[Incoming] = []
        self.publisher = MqttPublisher(settings(port, **more), self.outbox, self.requests.append)


@contextlib.asynccontextmanager
async def running(link: Link) -> AsyncIterator[Link]:
    asyncio.get_running_loop().set_exception_handler(DisconnectErrorFilter())
    task = asyncio.create_task(link.publisher.run(), name="publisher")
    try:
        yield link
    finally:
        task.cancel()
        await asyncio.wait([task])
        assert task.cancelled()


async def test_a_socket_closed_before_its_turn_leaves_no_traceback_in_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The filter drops the error of a socket that is closed before its callback runs."""
    noise, client = DisconnectErrorFilter(), aiomqtt.Client("127.0.0.1")
    asyncio.get_running_loop().set_exception_handler(noise)
    with socket.socket() as sock:
        client._on_socket_register_write(client._client, None, sock)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert noise.dropped == 1
    assert not caplog.records


@pytest.mark.parametrize(
    ("error", "fault"),
    [
        (aiomqtt.MqttCodeError(4), "connection was lost"),  # paho's number of "not connected"
        (aiomqtt.MqttError("Operation timed out"), "does not answer in time"),
        (aiomqtt.MqttError("something else"), "something else"),
    ],
)
def test_session_fault_contains_no_library_code(error: aiomqtt.MqttError, fault: str) -> None:
    assert fault in session_fault(error)
    assert "code:" not in session_fault(error)


@pytest.mark.parametrize("code", [5, 135])
def test_not_authorized_suggests_the_password_file(code: int) -> None:
    assert "password_file" in broker_fault(aiomqtt.MqttCodeError(code))


def test_a_connection_that_ended_without_a_reason_is_reported_as_lost() -> None:
    ended = aiomqtt.MqttCodeError(ReasonCode(PacketTypes.DISCONNECT, "Unspecified error"))
    assert "connection was lost" in broker_fault(ended)


@contextlib.asynccontextmanager
async def answering(connack: bytes) -> AsyncIterator[int]:
    """Run a broker that answers every CONNECT with `connack`; yield the port of the broker."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(1000)
        writer.write(connack)
        await writer.drain()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server:
        yield server.sockets[0].getsockname()[1]


@pytest.mark.parametrize(
    ("version", "code", "remedy"),
    [
        ("5", 128, "refused the connection without a known reason: check its log"),
        ("5", 137, "busy: wait"),
        ("5", 140, "enable a user name with a password in the broker"),
        ("5", 149, "raise its limit"),
        ("5", 156, "correct host and port in [mqtt]"),
        ("5", 157, "correct host and port in [mqtt]"),
        ("5", 155, "refused the connection with code 155: check its log"),
        ("3.1.1", 1, 'refuses MQTT 3.1.1, or this port does not serve MQTT: set version = "5"'),
        ("3.1.1", 9, "refused the connection without a known reason: check its log"),
    ],
)
async def test_refused_connection_names_cause_and_remedy(
    version: Literal["3.1.1", "5"], code: int, remedy: str
) -> None:
    answer = bytes((0x20, 3, 0, code, 0) if version == "5" else (0x20, 2, 0, code))
    async with answering(answer) as port:
        settings = MqttSettings(host="127.0.0.1", port=port, version=version)
        with pytest.raises(BrokerLostError) as lost:
            async with MqttConnection(settings):
                pass
    assert remedy in str(lost.value)
    assert "code:" not in str(lost.value)


async def test_stop_at_the_connack_is_not_lost(
    broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    connect = aiomqtt.Client.__aenter__

    async def connected_after_all(client: aiomqtt.Client) -> aiomqtt.Client:
        made = await connect(client)
        link.cancel()
        with contextlib.suppress(asyncio.CancelledError):  # wait_for of Python 3.11 may raise it
            await asyncio.sleep(0)
        return made

    monkeypatch.setattr(aiomqtt.Client, "__aenter__", connected_after_all)
    link = asyncio.create_task(Link(broker.port).publisher.run())
    await asyncio.wait([link], timeout=5)
    assert link.cancelled()


async def until(condition: Callable[[], bool], within_s: float = 5.0) -> None:
    async with asyncio.timeout(within_s):
        while not condition():
            await asyncio.sleep(0.01)


async def retained(port: int, wanted: int) -> dict[str, bytes]:
    """Return the retained messages for a new client when there are `wanted` topics."""
    found: dict[str, bytes] = {}
    async with asyncio.timeout(5), MqttConnection(settings(port)) as watcher:
        await watcher.subscribe([f"{BASE}/#"])
        async for message in watcher.messages():
            found[message.topic] = message.payload
            if len(found) >= wanted:
                break
    return found


async def test_retained_state_is_restored_after_a_broker_restart(
    broker: Broker,
) -> None:
    link = Link(broker.port)
    state = {f"{BASE}/device/S{n}/availability": ONLINE for n in range(20)}
    for topic, payload in state.items():
        link.outbox.retain(topic, payload)
    async with running(link):
        assert await retained(broker.port, 21) == state | {LIFE: ONLINE}
        broker.stop()
        await until(lambda: not link.publisher.connected)
        broker.start()
        began = time.monotonic()
        await until(lambda: link.publisher.connected)
        back_s = time.monotonic() - began
        assert await retained(broker.port, 21) == state | {LIFE: ONLINE}
    assert back_s < 3  # the specified time is 1 s; the machine may be busy


async def test_absent_broker_at_start_is_awaited(broker: Broker) -> None:
    broker.stop()
    link = Link(broker.port)
    async with running(link):
        await asyncio.sleep(0.3)
        assert not link.publisher.connected
        broker.start()
        await until(lambda: link.publisher.connected)
        assert await retained(broker.port, 1) == {LIFE: ONLINE}


async def test_absent_broker_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        async with running(Link(free_port())):
            await asyncio.sleep(1.5)
    said = [record.getMessage() for record in caplog.records if "retrying" in record.message]
    assert len(said) == 1
    assert "broker 127.0.0.1:" in said[0]


async def test_stop_during_a_connection_loss_ends_the_publisher() -> None:
    for n in range(60):  # the connection is refused within the longest of these waits
        async with asyncio.timeout(2), running(Link(free_port())):
            await asyncio.sleep(0.0002 * n)


async def test_online_is_published_last(broker: Broker) -> None:
    link = Link(broker.port)
    order: list[str] = []
    for n in range(5):
        link.outbox.retain(f"{BASE}/z{n}", b"1")
    async with MqttConnection(settings(broker.port)) as watcher:
        await watcher.subscribe([f"{BASE}/#"])
        async with running(link), asyncio.timeout(5):
            async for message in watcher.messages():
                order.append(message.topic)
                if len(order) == 6:
                    break
    assert order[-1] == LIFE


async def test_will_marks_a_killed_daemon_offline(broker: Broker) -> None:
    will = Outgoing(LIFE, OFFLINE, 1, retain=True)

    async def vanish() -> None:
        async with MqttConnection(settings(broker.port), will=will) as connection:
            await connection.publish(Outgoing(LIFE, ONLINE, 1, retain=True))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await vanish()
    await asyncio.sleep(0.2)
    assert await retained(broker.port, 1) == {LIFE: OFFLINE}


async def test_stopped_daemon_publishes_offline(broker: Broker) -> None:
    async with running(Link(broker.port)) as link:
        await until(lambda: link.publisher.sent > 0)
    assert await retained(broker.port, 1) == {LIFE: OFFLINE}


async def test_late_will_of_an_earlier_process_is_overwritten(broker: Broker) -> None:
    async with running(Link(broker.port)) as link:
        await until(lambda: bool(link.publisher.health().confirmed))
        async with MqttConnection(settings(broker.port)) as other:
            await other.publish(Outgoing(LIFE, OFFLINE, 1, retain=True))
        async with asyncio.timeout(5):
            while await retained(broker.port, 1) != {LIFE: ONLINE}:
                await asyncio.sleep(0.05)


async def test_retained_request_is_never_executed(
    broker: Broker, caplog: pytest.LogCaptureFixture
) -> None:
    topic = f"{BASE}/bridge/request/calibrate"
    port = broker.port_of("3.1.1")
    async with MqttConnection(settings(port, version="3.1.1")) as operator:
        await operator.publish(Outgoing(topic, b'{"phase":"abort"}', 1, retain=True))
        async with running(Link(port, version="3.1.1")) as link:
            await until(lambda: link.publisher.ignored_requests == 1)
            await operator.publish(Outgoing(topic, b'{"phase":"static"}', 1))
            await until(lambda: len(link.requests) == 1)
    assert link.requests[0].payload == b'{"phase":"static"}'
    assert "it is retained" in caplog.text


async def test_with_mqtt_5_stored_requests_are_not_sent(mosquitto: Broker) -> None:
    topic = f"{BASE}/bridge/request/calibrate"
    async with MqttConnection(settings(mosquitto.port)) as operator:
        await operator.publish(Outgoing(topic, b'{"phase":"abort"}', 1, retain=True))
        async with running(Link(mosquitto.port)) as link:
            await until(lambda: bool(link.publisher.health().confirmed))
            await operator.publish(Outgoing(topic, b'{"phase":"static"}', 1))
            await until(lambda: len(link.requests) == 1)
    assert link.requests[0].payload == b'{"phase":"static"}'
    assert link.publisher.ignored_requests == 0


async def test_with_mqtt_5_new_retained_request_is_not_executed(
    mosquitto: Broker,
) -> None:  # needs "retain as published", which the embedded broker does not have
    async with running(Link(mosquitto.port)) as link:
        await until(lambda: bool(link.publisher.health().confirmed))
        async with MqttConnection(settings(mosquitto.port)) as operator:
            topic = f"{BASE}/bridge/request/calibrate"
            await operator.publish(Outgoing(topic, b"{}", 1, retain=True))
            await until(lambda: link.publisher.ignored_requests == 1)
    assert link.requests == []


async def test_unresponsive_broker_is_detected_and_the_queue_stays_limited(
    broker: Broker,
) -> None:
    async with running(Link(broker.port)) as link:
        await until(lambda: link.publisher.connected)
        broker.freeze()
        began = time.monotonic()
        while link.publisher.connected:
            link.outbox.stream(f"{BASE}/pose", bytes(600))
            await asyncio.sleep(0.005)
            assert time.monotonic() - began < 12
        assert link.outbox.queued < 600
        broker.thaw()
        await until(lambda: link.publisher.connected, 8)


async def test_daemon_stops_under_load_in_thirty_of_thirty_attempts(broker: Broker) -> None:
    for number in range(30):
        link = Link(broker.port)
        task = asyncio.create_task(link.publisher.run(), name="publisher")
        await until(lambda link=link: link.publisher.connected)  # type: ignore[misc]

        async def load(link: Link = link) -> None:
            while True:
                for _ in range(20):
                    link.outbox.stream(f"{BASE}/pose", bytes(500))
                link.outbox.event(f"{BASE}/bridge/event", b"{}")
                await asyncio.sleep(0)

        loading = asyncio.create_task(load(), name="load")
        await asyncio.sleep(0.01 + 0.002 * number)
        loading.cancel()
        task.cancel()
        done, _ = await asyncio.wait([task, loading], timeout=5)
        assert len(done) == 2, f"stop {number} hangs"


async def test_broker_without_mqtt_5_is_reported_without_fallback(
    embedded_broker: Broker,
) -> None:
    with pytest.raises(BrokerLostError, match=r'version = "3\.1\.1"'):
        async with MqttConnection(settings(embedded_broker.port_of("3.1.1"))):
            pass
    async with MqttConnection(settings(embedded_broker.port_of("3.1.1"), version="3.1.1")):
        pass


@pytest.mark.parametrize("version", ["5", "3.1.1"])
async def test_the_embedded_broker_serves_both_versions(
    embedded_broker: Broker, version: str
) -> None:
    port = embedded_broker.port_of(version)
    async with running(Link(port, version=version)) as link:
        await until(lambda: bool(link.publisher.health().confirmed))
        async with MqttConnection(settings(port, version=version)) as watcher:
            await watcher.subscribe([f"{BASE}/pose"])
            link.outbox.stream(f"{BASE}/pose", b"{}")
            async with asyncio.timeout(5):
                message = await anext(watcher.messages())
    assert message.payload == b"{}"


async def test_forbidden_topic_is_detected_by_the_echo(
    tmp_path: Path,
    start_mosquitto: Callable[[str], Broker],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr("jointfit_daemon.outputs.mqtt._publisher.ECHO_S", 0.5)
    (tmp_path / "acl").write_text("topic read #\n")
    (tmp_path / "acl").chmod(0o600)
    broker = start_mosquitto(f"acl_file {tmp_path / 'acl'}\n")
    async with running(Link(broker.port)) as link:
        await until(lambda: link.publisher.connected)
        await asyncio.sleep(1)
        assert link.publisher.health().confirmed is False
    assert "check its ACL" in caplog.text


async def test_wrong_password_is_reported(
    tmp_path: Path, start_mosquitto: Callable[[str], Broker]
) -> None:
    passwords = tmp_path / "passwords"
    passwords.write_text("")
    passwords.chmod(0o600)
    broker = start_mosquitto(f"password_file {passwords}\n")
    secret = tmp_path / "secret"
    secret.write_text("wrong\n")
    login = settings(broker.port, username="daemon", password_file=str(secret))
    with pytest.raises(BrokerLostError, match=r"(?i)not auth|bad user"):
        async with MqttConnection(login):
            pass


async def test_messages_have_expiry_content_type_and_version(
    broker: Broker,
) -> None:
    async with (
        aiomqtt.Client("127.0.0.1", broker.port, protocol=aiomqtt.ProtocolVersion.V5) as reader,
        MqttConnection(settings(broker.port)) as connection,
    ):
        await reader.subscribe("#")
        await connection.publish(Outgoing("a", b"{}", expiry_s=2, correlation=b"7"))
        message = await anext(reader.messages)
    found = vars(message.properties)
    assert found["ContentType"] == "application/json"
    assert found["UserProperty"] == [("v", "1")]
    assert found["CorrelationData"] == b"7"
    assert found["MessageExpiryInterval"] <= 2


async def test_client_receives_the_answer_to_its_request(broker: Broker) -> None:
    link = Link(broker.port)

    def answer(message: Incoming) -> None:
        asked = orjson.loads(message.payload)
        for transaction in ("somebody else's", asked["transaction"]):
            payload = orjson.dumps({"transaction": transaction, "status": "ok", "data": asked})
            link.outbox.event(f"{BASE}/bridge/response/calibrate", payload)

    link.publisher = MqttPublisher(settings(broker.port), link.outbox, answer)
    async with running(link), MqttClient(settings(broker.port)) as client:
        await until(lambda: bool(link.publisher.health().confirmed))
        reply = await client.request("calibrate", {"phase": "static"})
        assert reply["status"] == "ok"
        assert reply["data"]["phase"] == "static"
        await client.subscribe("bridge/state")
        async with asyncio.timeout(5):
            assert await anext(client.messages()) == ("bridge/state", {"v": 1, "state": "online"})


async def test_client_without_answer_raises_no_answer_error(broker: Broker) -> None:
    async with MqttClient(settings(broker.port)) as client:
        with pytest.raises(NoAnswerError, match="check that jointfitd is running"):
            await client.request("calibrate", {}, timeout_s=0.2)


async def test_client_raises_broker_lost_error(broker: Broker) -> None:
    async with MqttClient(settings(broker.port)) as client:
        broker.stop()
        with pytest.raises(BrokerLostError):
            await anext(client.messages())


async def test_connecting_can_be_cancelled_at_any_moment(broker: Broker) -> None:
    broker.freeze()  # accepts connections but never answers
    connecting = asyncio.create_task(MqttConnection(settings(broker.port)).__aenter__())
    await asyncio.sleep(0.2)
    connecting.cancel()
    await asyncio.wait([connecting], timeout=2)
    assert connecting.cancelled()


async def test_messages_after_a_transmission_are_acknowledged_without_the_delay_of_the_kernel(
    broker: Broker,
) -> None:
    async with MqttConnection(settings(broker.port)) as connection:
        await connection.subscribe([f"{BASE}/#"])
        for number in range(8):  # the kernel delays acknowledgements after some exchanges
            await connection.publish(Outgoing(f"{BASE}/a", b"%d" % number, 1))
            await anext(connection.messages())
        sock: Any = connection._client._client.socket()
        assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK) == 1
