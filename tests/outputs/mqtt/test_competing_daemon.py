"""Two daemons with one client id: one connection remains, and the other daemon waits."""

from __future__ import annotations

import asyncio
import contextlib
import random
from itertools import count
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs.mqtt import DisconnectErrorFilter, Incoming, MqttPublisher, Outbox
from jointfit_daemon.outputs.mqtt._competing_daemon import (
    NEWCOMER_S,
    SHORT_S,
    TakeoverDetector,
)
from jointfit_daemon.outputs.mqtt._connection import MqttConnection, Outgoing
from jointfit_daemon.outputs.topics import OFFLINE, ONLINE

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from tests.broker_fixture import Broker

BASE = "jointfit/bench"
POSE_S = 0.05


@contextlib.asynccontextmanager
async def daemon_link(port: int, version: str) -> AsyncIterator[MqttPublisher]:
    """Yield the link of one daemon that publishes poses continuously."""
    asyncio.get_running_loop().set_exception_handler(DisconnectErrorFilter())
    outbox = Outbox(f"{BASE}/bridge/state")
    more: dict[str, Any] = {"version": version}
    settings = MqttSettings(host="127.0.0.1", port=port, base=BASE, **more)
    link = MqttPublisher(settings, outbox, lambda _: None)

    async def pose() -> None:
        while True:
            outbox.stream(f"{BASE}/pose", b"{}")
            await asyncio.sleep(POSE_S)

    tasks = [asyncio.create_task(link.run()), asyncio.create_task(pose())]
    try:
        yield link
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)


async def until(condition: Callable[[], bool], within_s: float = 20.0) -> None:
    async with asyncio.timeout(within_s):
        while not condition():
            await asyncio.sleep(0.01)


def refusals(caplog: pytest.LogCaptureFixture) -> list[str]:
    messages = [record.getMessage() for record in caplog.records]
    return [message for message in messages if "Publishing is paused" in message]


@pytest.mark.usefixtures("unseen")
@pytest.mark.system
@pytest.mark.parametrize("version", ["5", "3.1.1"])
async def test_newer_daemon_waits_until_the_first_is_gone(
    broker: Broker,
    version: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    port = broker.port_of(version)
    monkeypatch.setattr("jointfit_daemon.outputs.mqtt._competing_daemon.SHORT_S", 2.0)
    monkeypatch.setattr("jointfit_daemon.outputs.mqtt._competing_daemon.SETTLED_S", 0.5)
    async with contextlib.AsyncExitStack() as newer:
        async with daemon_link(port, version) as older:
            await until(lambda: older.connected)
            await asyncio.sleep(2.2)  # longer than SHORT_S: the older daemon counts as established

            newcomer = await newer.enter_async_context(daemon_link(port, version))
            await until(lambda: bool(refusals(caplog)))
            await until(lambda: older.connected)

            connects = older.connects, newcomer.connects
            await asyncio.sleep(1.5)
            assert older.connected
            assert (older.connects, newcomer.connects) == connects
        await until(lambda: newcomer.connected)
    (refusal,) = refusals(caplog)
    assert "client id 'jointfitd-jointfit-bench', probably a second jointfitd" in refusal


@pytest.mark.parametrize("version", ["5", "3.1.1"])
async def test_newer_daemon_publishes_nothing_and_leaves_the_first_connected(
    broker: Broker, version: str, caplog: pytest.LogCaptureFixture
) -> None:
    port = broker.port_of(version)
    more: dict[str, Any] = {"version": version}
    settings = MqttSettings(host="127.0.0.1", port=port, base=BASE, **more)
    async with daemon_link(port, version) as older, MqttConnection(settings) as watcher:
        await until(lambda: older.sent > 2)
        await watcher.subscribe([f"{BASE}/bridge/#", f"{BASE}/device/#"], live=True)

        async with daemon_link(port, version) as newcomer:
            newcomer._outbox.retain(f"{BASE}/device/S1/availability", b"offline")
            await until(lambda: bool(refusals(caplog)))
            await asyncio.sleep(0.2)
            assert (older.connects, newcomer.connects) == (1, 0)
        await asyncio.sleep(0.1)
        assert older.connects == 1

        # The retained state that the older daemon published earlier may arrive as well. With MQTT
        # 3.1.1 the broker always sends it. With MQTT 5 only the embedded broker sends it, if it
        # stored the state during the subscription.
        reader, new = watcher.messages(), list[Incoming]()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(0.1):
                while True:
                    new.append(await anext(reader))
        assert [each for each in new if not each.retained or each.payload != ONLINE] == []


@pytest.mark.parametrize("stored", [ONLINE, OFFLINE])
async def test_stored_state_of_a_dead_daemon_does_not_stop_a_new_one(
    broker: Broker, stored: bytes, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("jointfit_daemon.outputs.mqtt._competing_daemon.GLANCE_S", 0.2)
    settings = MqttSettings(host="127.0.0.1", port=broker.port, base=BASE)
    async with MqttConnection(settings) as earlier:
        await earlier.publish(Outgoing(f"{BASE}/bridge/state", stored, 1, retain=True))
    async with daemon_link(broker.port, "5") as link:
        await until(lambda: link.connected, 3)
    assert not refusals(caplog)


@pytest.fixture
def unseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Prevent the daemons from detecting each other before they connect.

    Two daemons that start at the same time do not detect each other either.
    """

    async def is_in_use(settings: MqttSettings, offline: bytes) -> bool:
        del settings, offline
        return False

    monkeypatch.setattr("jointfit_daemon.outputs.mqtt._publisher.is_in_use", is_in_use)


@pytest.mark.usefixtures("unseen")
@pytest.mark.system
@pytest.mark.parametrize("version", ["5", "3.1.1"])
async def test_first_of_two_daemons_that_start_together_continues(
    broker: Broker, version: str, caplog: pytest.LogCaptureFixture
) -> None:
    port = broker.port_of(version)
    async with daemon_link(port, version) as older:
        await until(lambda: older.connected)
        await asyncio.sleep(0.6)

        async with daemon_link(port, version) as newcomer:
            await until(lambda: bool(refusals(caplog)))
            await until(lambda: older.connected)
            connects = older.connects, newcomer.connects
            await asyncio.sleep(0.7)
            assert older.connected
            assert not newcomer.connected
            assert (older.connects, newcomer.connects) == connects

    losses = [m for m in caplog.messages if "ended without a reason" in m]
    assert len(losses) == 2  # one line from each daemon
    assert all("another client uses the client id 'jointfitd-jointfit-bench'" in m for m in losses)
    assert "check that the broker runs" not in caplog.text


CONNACK, TAKEN_OVER = b"\x20\x03\x00\x00\x00", b"\xe0\x02\x8e\x00"


@pytest.mark.usefixtures("unseen")
async def test_takeover_reason_of_the_broker_suffices(caplog: pytest.LogCaptureFixture) -> None:
    """The broker of this test sends a reason, as do releases of mosquitto after 2.0.11.

    Mosquitto 2.0.11 and the embedded broker end the older connection without a reason.
    """
    serving: list[asyncio.Task[None] | None] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        serving.append(asyncio.current_task())
        await reader.read(1000)
        writer.write(CONNACK)
        await asyncio.sleep(0.1)
        writer.write(TAKEN_OVER)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server, daemon_link(server.sockets[0].getsockname()[1], "5") as link:
        await until(lambda: bool(refusals(caplog)))
        assert link.connects == 1
    await asyncio.gather(*filter(None, serving))


@pytest.mark.usefixtures("unseen")
async def test_broker_that_falls_silent_raises_no_suspicion(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("jointfit_daemon.outputs.mqtt._connection.ANSWER_S", 0.1)
    serving: list[asyncio.Task[None] | None] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        serving.append(asyncio.current_task())
        await reader.read(1000)
        writer.write(CONNACK)
        while await reader.read(1000):  # reads all bytes and sends no answer
            pass
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server, daemon_link(server.sockets[0].getsockname()[1], "5") as link:
        await until(lambda: link.connects >= 3)
        assert link._takeovers._losses == 0
    await asyncio.gather(*filter(None, serving))


def test_one_short_connection_raises_suspicion_only_with_a_reason() -> None:
    detector = TakeoverDetector()
    assert detector.suspects(0.1, taken_over=True)
    detector = TakeoverDetector()
    assert [detector.suspects(0.1, taken_over=False) for _ in range(3)] == [False, False, True]


def takeovers(first: TakeoverDetector, gap_s: float, handshake_s: float, reason: bool) -> list[int]:
    """Return which of two daemons lost each connection, until one of them gives way.

    Daemon 1 connects `gap_s` after daemon 0. The publisher waits after each loss, for a random time
    between half of a limit and this limit. The limit is 0.05 s at first and doubles up to 0.6 s.
    """
    waits = random.Random(1)
    detectors, delays_s, lost = (first, TakeoverDetector()), [0.05, 0.05], []
    lasted_s = gap_s
    for loss in count():
        loser = loss % 2
        lost.append(loser)
        if lasted_s >= NEWCOMER_S:
            delays_s[loser] = 0.05
        if detectors[loser].suspects(lasted_s, taken_over=reason):
            return lost
        lasted_s = handshake_s + delays_s[loser] * waits.uniform(0.5, 1.0)
        delays_s[loser] = min(2 * delays_s[loser], 0.6)
    raise AssertionError


@pytest.mark.parametrize("reason", [True, False])
@pytest.mark.parametrize("gap_s", [0.3, 1.6, 4.2, 6.0, 3600.0])
def test_daemon_that_connected_later_gives_way(gap_s: float, reason: bool) -> None:
    assert takeovers(TakeoverDetector(), gap_s, 0.02, reason)[-1] == 1


@pytest.mark.parametrize("reason", [True, False])
@pytest.mark.parametrize("gap_s", [1.6, 4.2, 6.0])
def test_daemon_that_connected_later_gives_way_over_a_slow_network(
    gap_s: float, reason: bool
) -> None:
    assert takeovers(TakeoverDetector(), gap_s, 0.6, reason)[-1] == 1


@pytest.mark.parametrize("reason", [True, False])
@pytest.mark.parametrize("handshake_s", [0.001, 0.02, 0.6, 4.0])
@pytest.mark.parametrize("gap_s", [0.001, 0.1, 0.24, 0.26, 0.6])
def test_one_of_two_simultaneous_daemons_gives_way_soon(
    gap_s: float, handshake_s: float, reason: bool
) -> None:
    assert len(takeovers(TakeoverDetector(), gap_s, handshake_s, reason)) <= 16


def test_established_daemons_give_way_to_a_client_that_never_does() -> None:
    detector = TakeoverDetector()
    assert not detector.suspects(3600.0, taken_over=True)
    assert any(detector.suspects(0.1, taken_over=False) for _ in range(10))


@pytest.mark.parametrize("gap_s", [0.0, 0.1])
def test_daemon_that_gave_way_does_so_again_after_a_restart_of_the_broker(gap_s: float) -> None:
    paused, other = TakeoverDetector(), TakeoverDetector()
    assert not other.suspects(3600.0, taken_over=False)
    assert not paused.suspects(3600.0, taken_over=False)
    paused.restart_count()
    assert not other.suspects(0.0, taken_over=False)  # 0 s: the broker was not reached
    assert takeovers(other, gap_s + 0.01, 0.02, reason=False)[-1] == 1
    assert paused.suspects(0.1, taken_over=True)


def test_first_daemon_reconnects_without_suspicion() -> None:
    detector = TakeoverDetector()
    assert not detector.suspects(SHORT_S + 1, taken_over=True)
    ended = [1.0, 1.0, SHORT_S + 1, 1.0, 0.0, 1.0]
    assert not any(detector.suspects(lasted_s, taken_over=False) for lasted_s in ended)
