"""The discovery message follows the rules of Home Assistant, and its templates read the payloads.

The rules are from its documentation ("MQTT discovery", "MQTT sensor", "MQTT binary sensor", "MQTT
button"). This module contains them as a JSON Schema.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
from typing import TYPE_CHECKING, Any

import jinja2
import jsonschema
import orjson
import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.outputs.home_assistant import discovery_payload, discovery_topic
from jointfit_daemon.outputs.mqtt import MqttPublisher, Outbox
from jointfit_daemon.outputs.mqtt._connection import MqttConnection, Outgoing
from jointfit_daemon.outputs.payload_models import PAYLOADS, payload_topic
from jointfit_daemon.outputs.payloads import TopicWriter
from jointfit_daemon.outputs.unix_clock import UnixClock
from jointfit_daemon.supervisor.requests import REQUESTS
from tests.supervisor.test_daemon import daemon, small, toml

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from jointfit_daemon.config import Rig
    from tests.broker_fixture import Broker

BASE = "jointfit/bench-1"
TOPIC = "homeassistant/device/jointfitd-jointfit-bench-1/config"
TEXT = {"type": "string", "minLength": 1}
ENTITY = {
    "platform": TEXT,
    "unique_id": TEXT,
    "name": TEXT,
    "icon": {"type": "string", "pattern": "^mdi:[a-z-]+$"},
    "entity_category": {"enum": ["config", "diagnostic"]},
    "qos": {"enum": [0, 1, 2]},
}
READING = {
    "state_topic": TEXT,
    "value_template": TEXT,
    "json_attributes_topic": TEXT,
    "json_attributes_template": TEXT,
    "expire_after": {"type": "integer", "minimum": 1},
}
SENSOR = {
    "device_class": {"const": "enum"},
    "options": {"type": "array", "items": TEXT, "minItems": 1},
    "unit_of_measurement": {"const": "°"},
    "state_class": {"const": "measurement"},
    "suggested_display_precision": {"type": "integer", "minimum": 0},
}
PLATFORMS: dict[str, Any] = {
    "sensor": {
        "properties": ENTITY | READING | SENSOR,
        "required": ["platform", "unique_id", "state_topic"],
        "dependentRequired": {"options": ["device_class"]},
        "dependentSchemas": {  # only numbers have a unit and statistics
            "options": {"not": {"anyOf": [{"required": ["unit_of_measurement"]},
                                          {"required": ["state_class"]}]}},
        },
    },
    "binary_sensor": {
        "properties": ENTITY | READING | {"device_class": {"const": "problem"}},
        "required": ["platform", "unique_id", "state_topic"],
    },
    "button": {
        "properties": ENTITY | {"command_topic": TEXT, "payload_press": TEXT},
        "required": ["platform", "unique_id", "command_topic"],
    },
}  # fmt: skip
DEVICE = {
    "type": "object",
    "properties": {
        "device": {
            "properties": {
                "identifiers": {"type": "array", "items": TEXT, "minItems": 1},
                **dict.fromkeys(("name", "manufacturer", "model", "sw_version"), TEXT),
            },
            "required": ["identifiers"],
            "additionalProperties": False,
        },
        "origin": {
            "properties": {"name": TEXT, "sw_version": TEXT, "support_url": TEXT},
            "required": ["name"],
            "additionalProperties": False,
        },
        "availability_topic": TEXT,
        "availability_template": TEXT,
        "components": {
            "type": "object",
            "minProperties": 1,
            "additionalProperties": {
                "oneOf": [
                    {
                        "additionalProperties": False,
                        **rules,
                        "properties": rules["properties"] | {"platform": {"const": name}},
                    }
                    for name, rules in PLATFORMS.items()
                ]
            },
        },
    },
    "required": ["device", "origin", "components"],
    "additionalProperties": False,
}


def rig_of(table: dict[str, Any], **mqtt: Any) -> Rig:
    return parse_rig(table | {"mqtt": {"home_assistant": {}} | mqtt})


@pytest.fixture(name="components")
def components_fixture(table: dict[str, Any]) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = discovery_payload(rig_of(table))["components"]
    return found


def value(template: str, payload: object) -> str:
    """Return the value that Home Assistant reads from a payload."""
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=False)
    return environment.from_string(template).render(value_json=payload)


def test_the_discovery_message_follows_the_rules(table: dict[str, Any]) -> None:
    payload = json.loads(orjson.dumps(discovery_payload(rig_of(table))))
    jsonschema.Draft202012Validator(DEVICE).validate(payload)
    unique = [component["unique_id"] for component in payload["components"].values()]
    assert len(set(unique)) == len(unique)
    assert discovery_topic(rig_of(table).mqtt) == TOPIC


def test_every_entity_reads_a_documented_topic_of_at_most_one_message_a_second(
    components: dict[str, dict[str, Any]],
) -> None:
    read = {c["state_topic"] for c in components.values() if "state_topic" in c}
    patterns = {payload_topic(topic.removeprefix(f"{BASE}/")) for topic in read}
    assert {topic.pattern for topic in patterns if topic} == {
        "joint/NAME", "calibration", "bridge/health",
    }  # fmt: skip


def test_every_template_reads_a_key_of_the_payload_model(
    components: dict[str, dict[str, Any]],
) -> None:
    for component in components.values():
        if component["platform"] != "sensor":
            continue
        topic = payload_topic(component["state_topic"].removeprefix(f"{BASE}/"))
        assert topic is not None
        keys = dict.fromkeys(PAYLOADS[topic].model_fields, 7)
        assert value(component["value_template"], keys) == "7"


def test_an_unknown_angle_is_unknown_to_home_assistant(
    components: dict[str, dict[str, Any]],
) -> None:
    flexion = components["knee_flexion"]
    assert value(flexion["value_template"], {"flexion_deg": 27.68}) == "27.68"
    assert value(flexion["value_template"], {"flexion_deg": None}) == "None"  # "None" means unknown


@pytest.mark.parametrize(
    ("health", "problem"),
    [
        ({"online": True, "sensor": "ok"}, "OFF"),
        ({"online": True, "sensor": "stuck"}, "ON"),
        ({"online": True, "sensor": "lost"}, "ON"),
        ({"online": False, "sensor": "ok"}, "ON"),
        ({"online": True}, "OFF"),  # cameras have no state `sensor`
    ],
)
def test_a_device_has_a_problem_when_disconnected_silent_or_stuck(
    table: dict[str, Any], health: dict[str, Any], problem: str
) -> None:
    table["imu"][0]["id"] = 'S 1\'s "front" é'
    components = discovery_payload(rig_of(table))["components"]
    name = table["imu"][0]["id"]
    template = components[f"device_{name}_problem"]["value_template"]
    assert value(template, {"devices": {name: health}}) == problem


def test_every_button_sends_a_request_that_the_daemon_accepts(
    components: dict[str, dict[str, Any]],
) -> None:
    buttons = [c for c in components.values() if c["platform"] == "button"]
    assert [b["name"] for b in buttons] == [
        "Static pose", "Calibrate by movement", "Abort calibration",
    ]  # fmt: skip
    for button in buttons:
        command = button["command_topic"].removeprefix(f"{BASE}/bridge/request/")
        REQUESTS[command].model.model_validate_json(button["payload_press"])


def test_there_are_no_buttons_where_requests_are_signed(table: dict[str, Any]) -> None:
    payload = discovery_payload(rig_of(table, request_key_file="key"))
    assert {c["platform"] for c in payload["components"].values()} == {"sensor", "binary_sensor"}


async def test_only_the_table_announces_a_rig(table: dict[str, Any]) -> None:
    outbox = Outbox("b/s")
    TopicWriter(parse_rig(table), outbox, UnixClock())
    assert not [topic for topic in outbox.retained if topic.startswith("homeassistant")]


async def test_a_removed_sensor_is_removed_from_home_assistant(table: dict[str, Any]) -> None:
    outbox = Outbox("b/s")
    writer = TopicWriter(rig_of(table), outbox, UnixClock())
    table["imu"] = [imu for imu in table["imu"] if imu["id"] != "S2"]
    writer.configure(rig_of(table))
    components = json.loads(outbox.retained[TOPIC])["components"]
    assert components["device_S2_problem"] == {"platform": "binary_sensor"}
    assert len(components["device_S1_problem"]) > 1


@pytest.mark.parametrize("mqtt", [{"home_assistant": {"enabled": False}}, {}])
async def test_a_rig_is_removed_when_the_table_is_removed_or_disabled(
    table: dict[str, Any], mqtt: dict[str, Any]
) -> None:
    outbox = Outbox("b/s")
    writer = TopicWriter(rig_of(table), outbox, UnixClock())
    writer.configure(parse_rig(table | {"mqtt": mqtt}))
    assert outbox.retained[TOPIC] == b""


@pytest.mark.parametrize("prefix", ["a//b", "home/#", "+"])
def test_a_prefix_that_is_no_topic_is_refused(table: dict[str, Any], prefix: str) -> None:
    with pytest.raises(Exception, match="levels separated by /"):
        rig_of(table, home_assistant={"prefix": prefix})


@contextlib.asynccontextmanager
async def publisher(rig: Rig) -> AsyncIterator[None]:
    outbox = Outbox(f"{BASE}/bridge/state")
    link = MqttPublisher(rig.mqtt, outbox, lambda _: None)
    TopicWriter(rig, outbox, UnixClock())
    task = asyncio.create_task(link.run(), name="publisher")
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait([task])


async def test_home_assistant_that_was_started_receives_the_rig_again_and_once_off_nothing(
    broker: Broker, table: dict[str, Any]
) -> None:
    on = rig_of(table, host=broker.host, port=broker.port)
    async with asyncio.timeout(10), MqttConnection(on.mqtt) as home:
        arriving = home.messages()
        await home.subscribe(["homeassistant/device/+/config"])
        async with publisher(on):
            first = await anext(arriving)
            await home.publish(Outgoing("homeassistant/status", b"offline", 1))
            await home.publish(Outgoing("homeassistant/status", b"online", 1))
            assert await anext(arriving) == first
        assert first.topic == TOPIC
        async with MqttConnection(on.mqtt) as later:  # the message is retained
            await later.subscribe([TOPIC])
            assert (await anext(later.messages())).payload == first.payload

        off = rig_of(table, host=broker.host, port=broker.port, home_assistant={"enabled": False})
        async with publisher(off):
            assert (await anext(arriving)).payload == b""


async def test_a_reload_without_the_table_removes_the_rig(
    broker: Broker, table: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    off = small(table, broker.port)
    on = off | {"mqtt": off["mqtt"] | {"home_assistant": {}}}
    async with asyncio.timeout(20), MqttConnection(parse_rig(on).mqtt) as home:
        await home.subscribe(["homeassistant/device/+/config"])
        arriving = home.messages()
        async with daemon(on, tmp_path):
            assert (await anext(arriving)).topic == TOPIC
            (tmp_path / "rig.toml").write_text(toml(off), encoding="utf-8")
            os.kill(os.getpid(), signal.SIGHUP)
            assert (await anext(arriving)).payload == b""
