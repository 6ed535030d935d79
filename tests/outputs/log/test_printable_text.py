"""Text of devices and servers cannot forge log lines or terminal escapes."""

from __future__ import annotations

import io
import logging
import os
import pty
import re
import sys
from typing import TYPE_CHECKING, Any

import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.__main__ import _log_handler
from jointfit_daemon.config import parse_rig
from jointfit_daemon.outputs.log import (
    LevelFormatter,
    PrintableRecord,
    journal_fields,
    printable,
    printable_data,
)
from jointfit_daemon.outputs.log._printable_text import LONGEST
from jointfit_daemon.outputs.payloads import TopicWriter
from jointfit_daemon.outputs.unix_clock import UnixClock
from jointfit_daemon.pipeline.events import DeviceInfo, Notice, NoticeKind, NoticeLevel

if TYPE_CHECKING:
    from collections.abc import Iterator

FORGED = "MTi-3\n2026-11-22 ERROR jointfitd: the leg fell off\r\x1b[2J\u202e\u2028x"


@given(st.text())
def test_any_text_becomes_one_printable_line(text: str) -> None:
    found = printable(text)
    assert found.isprintable()
    assert len(found.splitlines()) <= 1
    assert printable(found) == found


def test_long_text_is_cut_and_nested_data_bounded() -> None:
    assert len(printable("x" * 10_000)) == LONGEST
    nested: Any = "end"
    for _ in range(500):
        nested = [nested]
    assert len(orjson.dumps(printable_data({"a": nested, "b": 1.5}))) < 2 * LONGEST


@pytest.fixture
def printable_records() -> Iterator[None]:
    before = logging.getLogRecordFactory()
    logging.setLogRecordFactory(PrintableRecord)
    yield
    logging.setLogRecordFactory(before)


@pytest.mark.usefixtures("printable_records")
@pytest.mark.parametrize(
    "formatter", [logging.Formatter("%(levelname)s %(message)s"), LevelFormatter()]
)
def test_device_name_cannot_forge_a_log_line(formatter: logging.Formatter) -> None:
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(formatter)
    log = logging.Logger("device")  # noqa: LOG001 - a logger for this test
    log.addHandler(handler)
    log.warning("S1: %s", FORGED, extra=journal_fields("device", FORGED))
    lines = stream.getvalue().splitlines()
    assert all(
        line.lstrip("<4>").startswith(("WARNING S1", "device: S1", "  | ")) for line in lines
    )
    assert "\x1b" not in stream.getvalue()


class _Outbox:
    """An outbox that stores all messages."""

    def __init__(self) -> None:
        self.payloads: list[bytes] = []

    def retain(self, _: str, payload: bytes) -> None:
        self.payloads.append(payload)

    event = retain


def test_events_and_device_info_contain_no_control_characters(table: dict[str, Any]) -> None:
    outbox: Any = _Outbox()
    reporter = TopicWriter(parse_rig(table), outbox, UnixClock())
    outbox.payloads.clear()
    reporter.output(
        Notice(1, NoticeKind.DEVICE, "S1", FORGED, NoticeLevel.WARNING, {"name": [FORGED]})
    )
    reporter.output(DeviceInfo("S1", {"model": FORGED}))
    event, info = map(orjson.loads, outbox.payloads)
    assert all(
        text.isprintable() for text in (event["text"], *event["data"]["name"], info["model"])
    )
    assert "the leg fell off" in event["text"]


@pytest.mark.parametrize(
    ("on_terminal", "limited", "pattern"),
    [
        (True, True, r"\d\d:\d\d:\d\d INFO S1: streaming"),
        (True, False, r"\d{4}-\d\d-\d\d [\d:,]+ INFO jointfit_daemon: S1: streaming"),
        (False, True, r"\d{4}-\d\d-\d\d [\d:,]+ INFO jointfit_daemon: S1: streaming"),
    ],
)
def test_lines_on_a_terminal_are_short_unless_all_are_wanted(
    monkeypatch: pytest.MonkeyPatch, on_terminal: bool, limited: bool, pattern: str
) -> None:
    parent, child = pty.openpty() if on_terminal else os.pipe()
    for name in ("JOURNAL_STREAM", "INVOCATION_ID"):
        monkeypatch.delenv(name, raising=False)
    with os.fdopen(child, "w") as stream, os.fdopen(parent, "rb") as reader:
        monkeypatch.setattr(sys, "stderr", stream)
        handler = _log_handler("bench", limited=limited)
        record = logging.LogRecord(
            "jointfit_daemon", logging.INFO, "", 0, "S1: streaming", (), None
        )
        handler.handle(record)
        handler.flush()
        shown = os.read(reader.fileno(), 200).decode().strip()
    assert re.fullmatch(pattern, shown)
