"""Two daemons with one client id: one connection remains, and the other daemon waits."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs.mqtt import DisconnectErrorFilter, MqttPublisher, Outbox
from jointfit_daemon.outputs.mqtt._competing_daemon import SHORT_S, TakeoverDetector

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from tests.broker_fixture import Broker

BASE = "jointfit/bench"
POSE_S = 0.05


@contextlib.asynccontextmanager
async def daemon_link(port: int, version: str) -> AsyncIterator[MqttPublisher]:
    """Yield the link of one daemon that publishes poses all the time."""
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
            await asyncio.sleep(2.2)  # no longer a newcomer itself

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


CONNACK, TAKEN_OVER = b"\x20\x03\x00\x00\x00", b"\xe0\x02\x8e\x00"


async def test_takeover_reason_of_the_broker_suffices(caplog: pytest.LogCaptureFixture) -> None:
    """mosquitto 2.0.11 and iotcore give no reason; later releases of mosquitto do."""
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


def test_one_short_connection_raises_suspicion_only_with_a_reason() -> None:
    detector = TakeoverDetector()
    assert detector.suspects(1.0, taken_over=True)
    detector = TakeoverDetector()
    assert [detector.suspects(1.0, taken_over=False) for _ in range(3)] == [False, False, True]


def test_first_daemon_reconnects_without_suspicion() -> None:
    detector = TakeoverDetector()
    assert not detector.suspects(SHORT_S + 1, taken_over=True)
    ended = [1.0, 1.0, SHORT_S + 1, 1.0, 0.0, 1.0]
    assert not any(detector.suspects(lasted_s, taken_over=False) for lasted_s in ended)
