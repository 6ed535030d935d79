"""The broker settings of a fleet: a gateway's mosquitto forwards to a station's mosquitto.

Invariant: both brokers are real processes with the settings of examples/fleet as shipped; only
addresses and passwords are those of the test.
"""

from __future__ import annotations

import subprocess
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion

from tests.broker_fixture import MosquittoBroker

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "fleet"
BASE = "jointfit/wearer-01"
LINKED_S = 15.0
"""Time limit for the connection of the bridge, s. It is longer than its `restart_timeout`, 10 s."""

pytestmark = pytest.mark.skipif(
    MosquittoBroker.missing() is not None, reason=MosquittoBroker.missing() or ""
)


class RecordingClient:
    """A client that stores all received messages."""

    def __init__(self, port: int, user: str | None = None) -> None:
        self.messages: list[tuple[str, bytes]] = []
        self._client = Client(CallbackAPIVersion.VERSION2)
        if user is not None:
            self._client.username_pw_set(user, "secret")
        self._client.on_message = self._keep
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()

    def _keep(self, _client: Client, _data: object, message: MQTTMessage) -> None:
        self.messages.append((message.topic, bytes(message.payload)))

    def subscribe(self, topic: str) -> None:
        self._client.subscribe(topic, 1)

    def publish(self, topic: str, payload: bytes, qos: int = 1, *, retain: bool = False) -> None:
        self._client.publish(topic, payload, qos, retain).wait_for_publish(5.0)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


@contextmanager
def connected(port: int, user: str | None = None) -> Iterator[RecordingClient]:
    client = RecordingClient(port, user)
    try:
        yield client
    finally:
        client.close()


@contextmanager
def running(broker: MosquittoBroker) -> Iterator[MosquittoBroker]:
    broker.start()
    try:
        yield broker
    finally:
        broker.stop()


def until(found: Callable[[], bool], within_s: float = LINKED_S) -> None:
    end = time.monotonic() + within_s
    while not found():
        assert time.monotonic() < end, f"nothing within {within_s:g} s"
        time.sleep(0.05)


@pytest.fixture
def station(tmp_path: Path) -> Iterator[MosquittoBroker]:
    """Return the broker of the station, with accounts of two gateways, viewer and operator."""
    passwords = tmp_path / "station.passwd"
    names = ("wearer-01", "wearer-02", "viewer", "operator")
    passwords.write_text("".join(f"{name}:secret\n" for name in names), encoding="utf-8")
    passwords.chmod(0o600)
    subprocess.run(["mosquitto_passwd", "-U", str(passwords)], check=True)
    acl = tmp_path / "station.acl"
    acl.write_text((EXAMPLES / "station.acl").read_text(encoding="utf-8"), encoding="utf-8")
    acl.chmod(0o600)
    more = f"password_file {passwords}\nacl_file {acl}\n"
    broker = MosquittoBroker(tmp_path, more=more)
    text = broker.config.read_text(encoding="utf-8")
    broker.config.write_text(text.replace("allow_anonymous true", "allow_anonymous false"))
    with running(broker):
        yield broker


@pytest.fixture
def gateway(tmp_path: Path, station: MosquittoBroker) -> Iterator[MosquittoBroker]:
    """Return the broker of wearer-01, which forwards to the station."""
    bridge = (EXAMPLES / "gateway-bridge.conf").read_text(encoding="utf-8")
    bridge = bridge.replace("station.example.org:8883", f"127.0.0.1:{station.port}")
    bridge = bridge.replace("replace-this", "secret")
    bridge = "\n".join(line for line in bridge.splitlines() if "cafile" not in line)
    with running(MosquittoBroker(tmp_path, more=bridge)) as broker:
        yield broker


def test_the_bridge_forwards_states_and_displayed_poses_but_not_the_full_stream(
    station: MosquittoBroker, gateway: MosquittoBroker
) -> None:
    with connected(station.port, "viewer") as viewer, connected(gateway.port) as daemon:
        viewer.subscribe("jointfit/#")
        until(lambda: (f"{BASE}/link", b"1") in viewer.messages)
        sent = [
            ("bridge/state", b"online"), ("bridge/health", b"h"), ("device/S1/info", b"i"),
            ("pose/ui", b"p"), ("joint/knee", b"k"), ("calibration", b"c"),
        ]  # fmt: skip
        for topic in ("pose", "optical/pose", "bridge/log"):
            daemon.publish(f"{BASE}/{topic}", b"local")
        for topic, payload in sent:
            daemon.publish(f"{BASE}/{topic}", payload)
        until(lambda: len(viewer.messages) > len(sent))
        assert sorted(viewer.messages) == sorted(
            [(f"{BASE}/link", b"1"), *((f"{BASE}/{topic}", payload) for topic, payload in sent)]
        )


def test_a_request_of_the_station_reaches_the_gateway(
    station: MosquittoBroker, gateway: MosquittoBroker
) -> None:
    with connected(station.port, "operator") as operator, connected(gateway.port) as daemon:
        operator.subscribe(f"{BASE}/link")
        daemon.subscribe(f"{BASE}/bridge/request/+")
        until(lambda: (f"{BASE}/link", b"1") in operator.messages)
        operator.publish(f"{BASE}/bridge/request/mark", b'{"text":"start"}')
        until(lambda: (f"{BASE}/bridge/request/mark", b'{"text":"start"}') in daemon.messages)


def test_events_wait_for_the_station_and_retained_states_return_after_its_restart(
    station: MosquittoBroker, gateway: MosquittoBroker
) -> None:
    with connected(gateway.port) as daemon:
        with connected(station.port, "viewer") as viewer:
            viewer.subscribe(f"{BASE}/link")
            until(lambda: (f"{BASE}/link", b"1") in viewer.messages)
        daemon.publish(f"{BASE}/bridge/state", b"online", retain=True)

        station.stop()  # the broker loses its retained messages
        for number in range(3):
            daemon.publish(f"{BASE}/bridge/event", b"%d" % number)
        station.start()

        with connected(station.port, "viewer") as viewer:
            viewer.subscribe("jointfit/#")
            until(lambda: (f"{BASE}/bridge/state", b"online") in viewer.messages)
            until(lambda: (f"{BASE}/bridge/event", b"2") in viewer.messages)
            events = [text for topic, text in viewer.messages if topic.endswith("/event")]
            assert events == [b"0", b"1", b"2"]


def test_the_station_reports_a_gateway_that_is_out_of_reach(
    station: MosquittoBroker, gateway: MosquittoBroker
) -> None:
    with connected(station.port, "viewer") as viewer:
        viewer.subscribe(f"{BASE}/link")
        until(lambda: (f"{BASE}/link", b"1") in viewer.messages)
        gateway.stop()
        until(lambda: viewer.messages[-1] == (f"{BASE}/link", b"0"))


def test_a_gateway_cannot_write_or_read_topics_of_another(station: MosquittoBroker) -> None:
    with (
        connected(station.port, "viewer") as viewer,
        connected(station.port, "wearer-02") as other,
        connected(station.port, "wearer-01") as own,
    ):
        viewer.subscribe("jointfit/#")
        other.subscribe("jointfit/#")
        time.sleep(0.2)
        other.publish(f"{BASE}/bridge/state", b"forged")
        own.publish(f"{BASE}/bridge/state", b"true")
        until(lambda: bool(viewer.messages))
        time.sleep(0.2)
        assert viewer.messages == [(f"{BASE}/bridge/state", b"true")]
        assert not other.messages
