"""Topics, flags and event kinds agree with docs/mqtt.md."""

from __future__ import annotations

import re
from pathlib import Path

from jointfit_daemon.model import FrameFlag, MarkerFlag
from jointfit_daemon.outputs.topics import DEVICE_INFO, POSE, TOPICS
from jointfit_daemon.pipeline.events import NoticeKind

PAGE = Path(__file__).resolve().parents[2] / "docs" / "mqtt.md"
ROW = re.compile(r"^\| `([^`]+)` \| ([R–]) \| ([01]) \|", re.MULTILINE)


def test_topics_equal_the_table_of_the_documentation() -> None:
    documented = [
        (name, retained == "R", int(qos))
        for name, retained, qos in ROW.findall(PAGE.read_text(encoding="utf-8"))
    ]
    assert documented == [(topic.pattern, topic.retained, topic.qos) for topic in TOPICS]


def test_flags_of_frames_equal_the_table_of_the_documentation() -> None:
    page = PAGE.read_text(encoding="utf-8")
    table = page.partition("| flag | meaning |\n|---|---|\n")[2].partition("\n\n")[0]
    cells = [line.split(" | ")[0] for line in table.splitlines()]
    documented = [flag for cell in cells for flag in re.findall(r"`(\w+)(?::[A-Z]+)?`", cell)]
    assert sorted(documented) == sorted(FrameFlag)


def test_flags_of_the_chain_model_equal_the_table_of_the_documentation() -> None:
    page = PAGE.read_text(encoding="utf-8")
    table = page.partition("| in `flags` | meaning |\n|---|---|\n")[2].partition("\n\n")[0]
    cells = [line.split(" | ")[0] for line in table.splitlines()]
    documented = [flag for cell in cells for flag in re.findall(r"`(\w+)(?::[A-Z~]+)?`", cell)]
    assert sorted(documented) == sorted(MarkerFlag)


def test_every_kind_of_event_is_documented() -> None:
    page = PAGE.read_text(encoding="utf-8")
    table = page.partition("| `kind` | reported |\n|---|---|\n")[2].partition("\n\n")[0]
    cells = [line.split(" | ")[0] for line in table.splitlines()]
    documented = [kind for cell in cells for kind in re.findall(r"`(\w+)`", cell)]
    assert sorted(documented) == sorted(NoticeKind)


def test_topic_name_replaces_the_placeholder() -> None:
    assert DEVICE_INFO.name("jointfit/a", "S1") == "jointfit/a/device/S1/info"
    assert POSE.name("jointfit/a") == "jointfit/a/pose"
