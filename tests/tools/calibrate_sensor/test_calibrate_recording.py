"""`jointfit calibrate sensor --recording` uses the movements in a recording of the daemon."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

from jointfit_daemon.config import load_rig
from jointfit_daemon.pipeline.events import ChunkArrived, Configured
from jointfit_daemon.tools.__main__ import app
from tests.outputs.recording.recorded_events import write_recording
from tests.tools.calibrate_sensor.moved_device import RIG, recorded_chunks

if TYPE_CHECKING:
    from pathlib import Path

    from typer.testing import Result


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of 7 s of rest and of an accelerometer step that is too short."""
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "rig.toml").write_text(RIG.format(port="/dev/ttyUSB0"), encoding="utf-8")
    chunks = recorded_chunks({"gyroscope": 7.0, "accelerometer": 3.0})
    configured = Configured(0, load_rig(folder / "rig.toml"), None)
    arrived = (ChunkArrived("S1", chunk) for chunk in chunks)
    return write_recording(folder, [configured, *arrived], name="bench")


def calibrate(recording: Path, rig: Path, *options: str) -> Result:
    words = ["calibrate", "sensor", "S1", "--recording", str(recording), "--rig", str(rig)]
    return CliRunner().invoke(app, [*words, *options])


def written_rig(folder: Path) -> Path:
    path = folder / "rig.toml"
    path.write_text(RIG.format(port="/dev/ttyUSB0"), encoding="utf-8")
    path.chmod(0o640)
    return path


def test_a_step_of_a_recording_is_written_and_named_by_check(
    recording: Path, tmp_path: Path
) -> None:
    rig = written_rig(tmp_path)
    result = calibrate(recording, rig, "--steps", "gyroscope")
    assert result.exit_code == 0, result.output
    assert f"written to {rig}; the daemon uses it from its next start or reload" in result.output
    assert rig.stat().st_mode & 0o777 == 0o640
    shown = CliRunner().invoke(app, ["check", str(rig)])
    assert "S1: sensor calibration of 20" in shown.output
    assert ": gyroscope" in shown.output


def test_refused_steps_set_the_exit_code_and_the_others_are_written(
    recording: Path, tmp_path: Path
) -> None:
    rig = written_rig(tmp_path)
    result = calibrate(recording, rig, "--json")
    assert result.exit_code == 1
    data = json.loads(result.stdout)
    assert sorted(data["refused"]) == ["accelerometer", "magnetometer"]
    assert data["written"] == str(rig)
    assert data["gyroscope"]["degrees_of_freedom"] == 23
    assert load_rig(rig).sources[0].settings.sensor_calibration.parts == ("gyroscope",)


def test_print_leaves_the_file(recording: Path, tmp_path: Path) -> None:
    rig = written_rig(tmp_path)
    before = rig.read_bytes()
    result = calibrate(recording, rig, "--steps", "gyroscope", "--print")
    assert result.exit_code == 0
    assert rig.read_bytes() == before
    assert "[imu.sensor_calibration]\ndate = " in result.output


def test_no_result_leaves_the_file(recording: Path, tmp_path: Path) -> None:
    rig = written_rig(tmp_path)
    before = rig.read_bytes()
    result = calibrate(recording, rig, "--steps", "accelerometer")
    assert result.exit_code == 1
    assert f"{rig} is unchanged" in result.output
    assert rig.read_bytes() == before
