"""Hostile requests over MQTT neither stop the daemon nor delay its poses by `POSE_GAP_S`."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import time
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import aiomqtt
import orjson
import pytest
from hypothesis import given, seed, settings
from hypothesis import strategies as st
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from tests.system.station import (
    BASE,
    PATIENCE_S,
    SENSORS,
    Listener,
    Station,
    listening,
    load_factor,
    running,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from jointfit_daemon.tools.child_processes import ChildProcess
    from tests.broker_fixture import Broker

pytestmark = pytest.mark.system

REQUEST = f"{BASE}/bridge/request/calibrate"
RSS_GROWTH_BYTES = 20_000_000
"""Largest growth of the daemon's resident memory, bytes."""
POSE_GAP_S = 0.2
"""Longest interval between two poses on an idle machine, s."""
CASES = int(os.environ.get("JOINTFIT_FUZZ_CASES", "300"))
"""Number of messages of arbitrary content."""
MB = 1_000_000


def rss_bytes(daemon: ChildProcess) -> int:
    """Return the resident memory of the daemon."""
    assert daemon.process is not None
    pages = Path(f"/proc/{daemon.process.pid}/statm").read_text("ascii").split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def with_properties(**values: Any) -> Properties:
    """Return properties of a PUBLISH packet."""
    made: Any = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    for name, value in values.items():
        setattr(made, name, value)
    return made  # type: ignore[no-any-return]


@contextlib.asynccontextmanager
async def unharmed(daemon: ChildProcess, listener: Listener) -> AsyncIterator[None]:
    """Check that poses continue through the block and that the daemon's memory hardly grows."""
    await listener.more_poses(20)
    rss, first = rss_bytes(daemon), len(listener.poses) - 1
    yield
    await listener.more_poses(20)
    daemon.check()
    assert rss_bytes(daemon) - rss < RSS_GROWTH_BYTES

    poses = listener.poses[first:]
    seqs = [pose["seq"] for pose in poses]
    assert seqs == sorted(set(seqs))  # no forged pose among them
    written_us = [pose["t_us"] + 1e3 * pose["age_ms"] for pose in poses]
    gaps_s = [(b - a) / 1e6 for a, b in pairwise(written_us)]
    assert max(gaps_s) < POSE_GAP_S * load_factor()


async def answers(client: aiomqtt.Client, count: int) -> list[Any]:
    """Return the next `count` responses."""
    async with asyncio.timeout(PATIENCE_S):
        return [orjson.loads((await anext(client.messages)).payload) for _ in range(count)]


NESTED = b"[" * 1000 + b"]" * 1000
NESTED_OBJECTS = b'{"a":' * 400 + b"1" + b"}" * 400
UNKNOWN_KEYS = orjson.dumps({f"k{number}": number for number in range(1500)})


@pytest.mark.timeout(180)
async def test_malformed_signed_requests_are_answered_with_errors_and_cost_little_memory(
    tmp_path: Path, broker: Broker
) -> None:
    (tmp_path / "key").write_bytes(b"k" * 32)
    line = "health_s = 0.5\n"
    station = Station(tmp_path, broker.port)
    async with (
        station.simulator((line, f'{line}request_key_file = "{tmp_path / "key"}"\n')),
        station.daemon() as daemon,
        listening(station.port) as listener,
    ):
        await listener.connected(SENSORS)
        await send_malformed_requests(broker, daemon, listener)


async def send_malformed_requests(broker: Broker, daemon: ChildProcess, listener: Listener) -> None:
    """Send malformed requests; check the answers, the poses, the memory and the connection."""
    async with aiomqtt.Client(
        broker.host, broker.port, protocol=aiomqtt.ProtocolVersion.V5
    ) as attacker:
        await attacker.subscribe(f"{BASE}/bridge/response/#")
        async with unharmed(daemon, listener):
            for payload in (NESTED, NESTED_OBJECTS, UNKNOWN_KEYS, b"\xff", b"[]"):
                await attacker.publish(REQUEST, payload, 1)
            found = await answers(attacker, 5)
            assert {answer["status"] for answer in found} == {"error"}

            for topic in (f"{BASE}/pose", "/".join("a" * 301), f"{BASE}/bridge/response/a/#"):
                where = with_properties(ResponseTopic=topic)
                await attacker.publish(REQUEST, b'{"phase":"static"}', 1, properties=where)
            found = await answers(attacker, 3)
            assert {answer["error"]["key"] for answer in found} == {"response_topic"}

        async with unharmed(daemon, listener):
            for number in range(200):
                await attacker.publish(REQUEST, UNKNOWN_KEYS[: 16_000 + number])
                await asyncio.sleep(0.01)
        await listener.health()
        assert listener.latest["bridge/health"]["link"]["connects"] == 1


@pytest.mark.timeout(180)
async def test_request_of_forty_megabytes_does_not_stay_in_memory(
    tmp_path: Path, mosquitto: Broker
) -> None:
    async with (
        running(Station(tmp_path, mosquitto.port)) as (_, daemon, listener),
        aiomqtt.Client(mosquitto.host, mosquitto.port, timeout=30) as attacker,
        unharmed(daemon, listener),
    ):
        await attacker.publish(REQUEST, bytes(40 * MB), 1)


# --- fuzzing --------------------------------------------------------------------------------------

texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0#+"), max_size=40)
tables = st.dictionaries(
    st.sampled_from(["phase", "seconds", "force", "transaction", "nonce", "t_us", "signature"])
    | texts,
    st.none() | st.booleans() | st.integers() | st.floats() | texts | st.lists(st.none()),
)
payloads = (
    st.binary(max_size=200)
    | tables.map(lambda table: json.dumps(table, ensure_ascii=False).encode())
    | st.integers(0, 40_000).map(lambda size: b"[" * size)
)
topics = st.just(REQUEST) | texts.map(lambda level: f"{BASE}/bridge/request/{level}")
properties = st.fixed_dictionaries(
    {},
    optional={
        "ResponseTopic": texts.map(lambda level: f"{BASE}/bridge/response/{level}") | texts,
        "CorrelationData": st.binary(max_size=300),
        "UserProperty": st.lists(st.tuples(texts, texts), min_size=1, max_size=4),
        "ContentType": texts,
        "PayloadFormatIndicator": st.integers(0, 1),
        "MessageExpiryInterval": st.integers(0, 2**32 - 1),
    },
)


class Fuzzer:
    """MQTT client that sends arbitrary messages and reconnects when the broker rejects one."""

    def __init__(self, broker: Broker) -> None:
        self._broker = broker
        self.sent = 0

    def connect(self) -> Client:
        """Return a connected client with a network thread."""
        client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5)
        client.connect(self._broker.host, self._broker.port)
        client.loop_start()
        return client

    def run(self, examples: int) -> None:
        """Send `examples` messages with arbitrary topics, payloads and properties."""
        client = self.connect()

        @seed(0)
        @settings(max_examples=examples, database=None, deadline=None)
        @given(topics, payloads, properties, st.sampled_from([(0, False), (1, False), (2, True)]))
        def send(topic: str, payload: bytes, values: dict[str, Any], how: tuple[int, bool]) -> None:
            client.publish(topic, payload, *how, with_properties(**values))
            self.sent += 1
            time.sleep(0.002)

        try:
            send()
        finally:
            client.disconnect()
            client.loop_stop()


@pytest.mark.timeout(240)
async def test_malformed_and_random_requests_do_not_disturb_the_daemon(
    tmp_path: Path, broker: Broker, subtests: pytest.Subtests
) -> None:
    fuzzer = Fuzzer(broker)
    async with running(Station(tmp_path, broker.port)) as (_, daemon, listener):
        with subtests.test("malformed requests are answered with errors and cost little memory"):
            await send_malformed_requests(broker, daemon, listener)
        with subtests.test("random topics, payloads and properties"):
            async with unharmed(daemon, listener):
                await asyncio.to_thread(fuzzer.run, CASES)
            assert fuzzer.sent >= CASES
            await listener.health()
            assert listener.latest["bridge/health"]["link"]["connects"] == 1
