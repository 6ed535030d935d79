"""The table of topics and docs/mqtt.md agree."""

from __future__ import annotations

import re
from pathlib import Path

from jointfit_daemon.outputs.topics import DEVICE_INFO, POSE, TOPICS

PAGE = Path(__file__).resolve().parents[2] / "docs" / "mqtt.md"
ROW = re.compile(r"^\| `([^`]+)` \| ([R–]) \| ([01]) \|", re.MULTILINE)


def test_topics_equal_the_table_of_the_documentation() -> None:
    documented = [
        (name, retained == "R", int(qos))
        for name, retained, qos in ROW.findall(PAGE.read_text(encoding="utf-8"))
    ]
    assert documented == [(topic.pattern, topic.retained, topic.qos) for topic in TOPICS]


def test_topic_name_replaces_the_placeholder() -> None:
    assert DEVICE_INFO.name("jointfit/a", "S1") == "jointfit/a/device/S1/info"
    assert POSE.name("jointfit/a") == "jointfit/a/pose"
