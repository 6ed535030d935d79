"""Offline calibration repeats the phases of a recording and yields the live result."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.calibration.record import CalibrationStore, calibration_text
from jointfit_daemon.config import parse_rig
from jointfit_daemon.outputs.recording import Recorder
from jointfit_daemon.pipeline.events import Configured
from jointfit_daemon.reprocessing import (
    ReprocessingError,
    _processing,
    calibrate_recording,
    load_calibration,
)
from tests.pipeline.core_feed import BEGIN_NS
from tests.reprocessing.recorded_run import RecordedRun, rig_table

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.calibration import FitResult
    from jointfit_daemon.pipeline.events import FitJob


def test_result_is_that_of_the_live_session_with_its_date(run: RecordedRun) -> None:
    found = calibrate_recording(run.path)
    assert found.calibration is not None
    assert found.rejected is None
    date = found.calibration.created_utc
    assert date.startswith("2026-11-18T")  # the date of the session, not of today
    expected = calibration_text(replace(run.calibration, created_utc=date))
    assert calibration_text(found.calibration) == expected


def test_fit_is_computed_and_not_taken_from_the_recording(
    run: RecordedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    computed: list[str] = []
    compute = _processing.compute_fit

    def note(job: FitJob) -> FitResult:
        computed.append(job.work.name)
        return compute(job)

    monkeypatch.setattr(_processing, "compute_fit", note)
    calibrate_recording(run.path)
    assert computed == ["static"]


def test_another_rig_changes_the_result(run: RecordedRun) -> None:
    table = rig_table()
    table["imu"] = table["imu"][:3]
    found = calibrate_recording(run.path, parse_rig(table))
    assert found.calibration is not None
    assert set(found.calibration.sensor) == {"S1", "S2", "S3"}


def test_recording_without_a_phase_is_an_error(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, "r")
    recorder.event(Configured(BEGIN_NS, parse_rig(rig_table()), None))
    recorder.close()
    with pytest.raises(ReprocessingError, match="no calibration phase was requested"):
        calibrate_recording(tmp_path)


def test_calibration_file_is_read_back(run: RecordedRun, tmp_path: Path) -> None:
    store = CalibrationStore(tmp_path, "x")
    version = store.save(run.calibration)
    assert load_calibration(store.path(version)).to_dict() == run.calibration.to_dict()


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "other"])
def test_damaged_calibration_file_is_an_error_that_names_it(
    damage: str, run: RecordedRun, tmp_path: Path
) -> None:
    text = calibration_text(run.calibration)
    content = {
        "truncated": text[:-100],
        "flipped": text.replace("S1", "S7", 1),
        "empty": "",
        "other": json.dumps({"a": 1}),
    }[damage]
    path = tmp_path / "damaged.json"
    path.write_text(content)
    with pytest.raises(ReprocessingError, match=r"damaged\.json: cannot be used as a calibration"):
        load_calibration(path)
