"""`BrokerLink` finds rigs on a real broker, signs requests, and reports a lost connection."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Any

import orjson
import pytest

from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs.mqtt import NoAnswerError, find_rigs, verify
from jointfit_daemon.outputs.mqtt._connection import MqttConnection, Outgoing
from jointfit_daemon.tools.monitor._broker_link import BrokerLink
from jointfit_daemon.tools.monitor._monitor_state import MonitorState
from tests.tools.monitor.sample_rig import BASE, SampleRig, moment

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from tests.broker_fixture import Broker

pytestmark = pytest.mark.system
KEY = b"0123456789abcdef0123456789abcdef"


def settings(broker: Broker, **more: Any) -> MqttSettings:
    return MqttSettings(host=broker.host, port=broker.port, **more)


async def publish(broker: Broker, *messages: tuple[str, Any]) -> None:
    async with MqttConnection(settings(broker)) as connection:
        for topic, payload in messages:
            await connection.publish(Outgoing(topic, orjson.dumps(payload), 1, retain=True))


@contextlib.asynccontextmanager
async def linked(found: MqttSettings, state: MonitorState) -> AsyncIterator[BrokerLink]:
    link = BrokerLink(found, state, lambda: moment(0.0))
    task = asyncio.create_task(link.run())
    try:
        yield link
    finally:
        task.cancel()
        await asyncio.wait([task])


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(20):
        while not condition():
            await asyncio.sleep(0.01)


async def test_rigs_are_found_by_their_retained_information_at_any_depth(broker: Broker) -> None:
    info = SampleRig().info()
    await publish(
        broker,
        ("jointfit/a/bridge/info", info | {"rig": "A"}),
        ("lab/room/2/b/bridge/info", info | {"rig": "B"}),
        ("bare/bridge/info", ["no rig"]),
        ("other/x/bridge/info", {"zigbee": 1}),
    )
    found = await find_rigs(settings(broker), 0.5)
    assert found == {"jointfit/a": "A", "lab/room/2/b": "B"}


async def test_the_only_rig_is_shown_and_a_lost_broker_is_named(broker: Broker) -> None:
    state = MonitorState("broker")
    messages = [(f"{BASE}/{topic}", payload) for topic, payload in SampleRig().retained().items()]
    await publish(broker, *messages)
    async with linked(settings(broker), state):
        await until(lambda: state.rig.bridge == "online" and state.rig.health is not None)
        assert state.base == BASE
        assert state.rig.info is not None
        await until(lambda: set(state.rig.availability) == set(SampleRig().devices))
        broker.stop()
        await until(lambda: state.link == "lost")
        assert str(broker.port) in state.reason
        broker.start()
        await until(lambda: state.link == "connected")
        # The restarted broker has lost the retained message with the state of the daemon.
        assert state.rig.bridge == "unknown"


async def test_requests_are_signed_with_the_key_of_the_rig(broker: Broker, tmp_path: Path) -> None:
    (tmp_path / "key").write_bytes(KEY)
    found = settings(broker, base=BASE, request_key_file=str(tmp_path / "key"))
    topic = f"{BASE}/bridge/request/static"
    async with (
        MqttConnection(settings(broker)) as daemon,
        linked(found, state := MonitorState("")) as link,
    ):
        await daemon.subscribe([topic])
        await until(lambda: state.link == "connected")
        asking = asyncio.create_task(link.request("static", {}))
        message = await anext(daemon.messages())
        request = orjson.loads(message.payload)
        verify(KEY, topic, request, time.time_ns() // 1000)
        answer = {"v": 1, "transaction": request["transaction"], "status": "accepted",
                  "data": {"phase": "static"}, "error": None}  # fmt: skip
        await daemon.publish(Outgoing(f"{BASE}/bridge/response/static", orjson.dumps(answer), 1))
        assert (await asking)["status"] == "accepted"


async def test_a_refused_account_is_named(
    start_mosquitto: Callable[[str], Broker], tmp_path: Path
) -> None:
    (tmp_path / "accounts").touch(mode=0o600)
    refusing = start_mosquitto(f"password_file {tmp_path / 'accounts'}\nallow_anonymous false\n")
    state = MonitorState("broker")
    async with linked(settings(refusing, base=BASE), state):
        await until(lambda: state.link == "lost")
    assert "authori" in state.reason.lower()


async def test_without_a_connection_a_request_is_refused_at_once(broker: Broker) -> None:
    link = BrokerLink(settings(broker, base=BASE), MonitorState(""), lambda: moment(0.0))
    with pytest.raises(NoAnswerError, match="not connected"):
        await link.request("static", {})
