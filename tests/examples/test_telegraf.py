"""The Telegraf configuration reads what the daemon writes.

Telegraf is not in Debian, so these tests evaluate its rules of topics and JSON paths themselves.
"""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from jointfit_daemon.outputs.payload_models import payload_topic
from jointfit_daemon.outputs.payloads import encode_joint
from tests.examples.live_rig import BASE
from tests.outputs.payloads.test_payloads import STATE

CONFIGURATION = Path(__file__).resolve().parents[2] / "examples" / "telegraf" / "telegraf.conf"
PAYLOADS = {
    f"{BASE}/joint/knee": json.loads(encode_joint(STATE, 1, 1_795_250_060_351_823)),
    f"{BASE}/calibration": {
        "v": 1, "t_us": 1_795_250_060_351_823, "phase": "calibrated", "text": "done", "version": 3,
        "created_utc": None, "kept": None, "done": [], "quality": {},
    },
}  # fmt: skip


OPTIONS: dict[str, set[str]] = {
    "agent": {"flush_interval"},
    "inputs": {"mqtt_consumer"},
    "outputs": {"influxdb_v2"},
    "mqtt_consumer": {
        "servers", "topics", "topic_tag", "topic_parsing", "qos", "connection_timeout",
        "max_undelivered_messages", "persistent_session", "client_id", "username", "password",
        "data_format", "json_v2",
    },
    "topic_parsing": {"topic", "measurement", "tags", "fields", "types"},
    "json_v2": {
        "measurement_name", "measurement_name_path", "timestamp_path", "timestamp_format",
        "timestamp_timezone", "field", "tag", "object",
    },
    "field": {"path", "type", "rename", "optional"},
    "object": {
        "path", "optional", "timestamp_key", "timestamp_format", "timestamp_timezone", "renames",
        "fields", "tags", "included_keys", "excluded_keys", "disable_prepend_keys",
    },
    "influxdb_v2": {"urls", "token", "organization", "bucket"},
}  # fmt: skip
"""Options of the tables, from the documentation of Telegraf. With an unknown option, Telegraf does
not start."""


def inputs() -> dict[str, dict[str, Any]]:
    """Return the MQTT inputs by their only topic."""
    table = tomllib.loads(CONFIGURATION.read_text(encoding="utf-8"))
    return {each["topics"][0]: each for each in table["inputs"]["mqtt_consumer"]}


def matches(pattern: str, topic: str) -> bool:
    ours, theirs = pattern.split("/"), topic.split("/")
    return len(ours) == len(theirs) and all(
        a in ("+", b) for a, b in zip(ours, theirs, strict=True)
    )


def value_at(payload: Any, path: str) -> Any:
    """Return the value of a plain GJSON path: keys separated by dots."""
    for key in path.split("."):
        payload = payload[key]
    return payload


def point(settings: dict[str, Any], topic: str, payload: dict[str, Any]) -> dict[str, Any]:
    """Return measurement, tags, fields and time that Telegraf makes of a message."""
    (parsing,), (parser,) = settings["topic_parsing"], settings["json_v2"]
    levels = topic.split("/")
    assert matches(parsing["topic"], topic)
    marks = parsing["measurement"].split("/")
    assert len(marks) == len(levels)
    (measurement,) = (b for a, b in zip(marks, levels, strict=True) if a == "measurement")
    tags = {
        name: level
        for name, level in zip(parsing["tags"].split("/"), levels, strict=True)
        if name != "_"
    }
    fields: dict[str, Any] = {}
    time_at = parser.get("timestamp_path")
    for each in parser.get("object", []):
        assert each["path"] == "@this"
        time_at = each["timestamp_key"]
        hidden = {time_at, *each["excluded_keys"]}
        fields |= {key: value for key, value in payload.items() if key not in hidden}
    for each in parser.get("field", []):
        fields[each["path"].rpartition(".")[2]] = value_at(payload, each["path"])
    formats = parser.get("timestamp_format") or parser["object"][0]["timestamp_format"]
    return {
        "measurement": measurement,
        "tags": tags,
        "fields": {key: value for key, value in fields.items() if value is not None},
        "time": (value_at(payload, time_at), formats),
    }


def point_of(topic: str) -> dict[str, Any]:
    (settings,) = (each for pattern, each in inputs().items() if matches(pattern, topic))
    return point(settings, topic, PAYLOADS[topic])


def unknown_options(name: str, tables: Any) -> list[str]:
    """Return the options of a table, and of the tables below it, that Telegraf does not have."""
    found = []
    for table in tables if isinstance(tables, list) else [tables]:
        found += [f"{name}.{key}" for key in table.keys() - OPTIONS[name]]
        for key in table.keys() & OPTIONS.keys():
            found += unknown_options(key, table[key])
    return found


def test_every_option_is_documented_and_a_misspelled_one_is_noticed() -> None:
    table = tomllib.loads(CONFIGURATION.read_text(encoding="utf-8"))
    assert table.keys() <= OPTIONS.keys()
    assert [name for key in table for name in unknown_options(key, table[key])] == []
    table["inputs"]["mqtt_consumer"][0]["json_v2"][0]["object"][0]["exclude_keys"] = []
    assert unknown_options("inputs", table["inputs"]) == ["object.exclude_keys"]


def test_a_persistent_session_has_a_client_id_of_its_own() -> None:
    persistent = [each for each in inputs().values() if each.get("persistent_session")]
    names = [each["client_id"] for each in persistent]
    assert names
    assert len(set(names)) == len(names)
    assert all(each["qos"] >= 1 for each in persistent)


def test_a_joint_is_a_point_with_all_known_numbers_and_two_tags() -> None:
    found = point_of(f"{BASE}/joint/knee")
    assert (found["measurement"], found["tags"]) == ("joint", {"rig": "bench-1", "joint": "knee"})
    assert found["time"] == (1_795_250_060_351_823, "unix_us")
    assert found["fields"]["flexion_deg"] == 28.31
    assert found["fields"]["sd_deg"] == 1.4
    numbers = {key: value for key, value in found["fields"].items() if key != "patent_gimbal"}
    assert all(isinstance(value, float | int) for value in numbers.values())


def test_an_unknown_value_is_no_field() -> None:
    unknown = json.loads(encode_joint(STATE, 2, 1))
    found = point(inputs()["jointfit/+/joint/+"], f"{BASE}/joint/ankle", unknown)
    assert found["fields"] == {}


def test_the_calibration_is_a_point_with_phase_and_version() -> None:
    found = point_of(f"{BASE}/calibration")
    assert (found["measurement"], found["tags"]) == ("calibration", {"rig": "bench-1"})
    assert found["fields"] == {"phase": "calibrated", "text": "done", "version": 3}
    assert found["time"][1] == "unix_us"


@pytest.mark.parametrize("pattern", sorted(inputs()))
def test_every_subscription_is_a_documented_topic_of_at_most_one_message_a_second(
    pattern: str,
) -> None:
    topic = payload_topic(pattern.removeprefix("jointfit/+/"))
    assert topic is not None
    assert topic.pattern in {"joint/NAME", "calibration"}
    assert inputs()[pattern]["qos"] == topic.qos
