"""Log lines of calibrations and outages: each change once, with the file of the calibration."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.pipeline.events import (
    CalibrationPhase,
    CalibrationStatus,
    DeviceStatus,
    Notice,
    NoticeKind,
    NoticeLevel,
)
from jointfit_daemon.supervisor._notice_log import NoticeLog

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def lines(table: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> NoticeLog:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    return NoticeLog(parse_rig(table))


def test_each_change_of_the_calibration_has_a_line_with_its_file(
    lines: NoticeLog, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    caplog.set_level(logging.INFO)
    done = CalibrationPhase.CALIBRATED
    lines.output(CalibrationStatus(0, done, "calibrated"))
    lines.output(CalibrationStatus(0, done, "stored as version 2", 2))
    lines.output(CalibrationStatus(0, done, "new calibration rejected", 2, kept="worse"))
    lines.output(CalibrationStatus(0, done, "stored calibration loaded", 1))
    texts = [record.message for record in caplog.records]
    assert [text.split(str(tmp_path))[0] for text in texts] == [
        "calibration: calibrated",
        "calibration calibrated: stored as version 2 (",
        "calibration calibrated: new calibration rejected",
        "calibration calibrated: stored calibration loaded (version 1 in ",
    ]
    assert [record.levelname for record in caplog.records] == ["INFO", "INFO", "WARNING", "INFO"]


def test_a_remark_of_a_phase_has_one_line(
    lines: NoticeLog, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    remark = "knee: 5 of 12 flexions so far: walk"
    kind = NoticeKind.CALIBRATION
    lines.output(Notice(0, kind, "functional", remark, NoticeLevel.WARNING))
    text = f"fitting the functional trial; {remark}"
    lines.output(CalibrationStatus(0, CalibrationPhase.FITTING, text))
    assert [record.message for record in caplog.records] == [
        f"functional: {remark}",
        "calibration fitting: fitting the functional trial",
    ]


def test_a_lost_sensor_has_one_line_beside_that_of_its_source(
    lines: NoticeLog, caplog: pytest.LogCaptureFixture
) -> None:
    lines.output(DeviceStatus("S1", online=True))
    lines.output(Notice(0, NoticeKind.SENSOR, "S1", "no data", data={"state": "lost"}))
    lines.output(DeviceStatus("S1", online=False))
    lines.output(Notice(0, NoticeKind.DEVICE, "S1", "unplugged", NoticeLevel.WARNING))
    lines.write_due(1e12, stalled=False)
    assert [record.message for record in caplog.records] == ["S1: unplugged"]
    assert lines.online == set()
