"""`jointfit export` writes recordings and files in other formats, and refuses wrong input."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from typer.testing import CliRunner

from jointfit_daemon.files.sessions import SESSION_FORMATS, read_session, write_session
from jointfit_daemon.reprocessing import load_session
from jointfit_daemon.tools.__main__ import app
from tests.files.sessions.session_samples import walking_session
from tests.files.sessions.session_strategy import assert_same_group
from tests.reprocessing.recorded_run import RecordedRun, record_run

if TYPE_CHECKING:
    from pathlib import Path

run = CliRunner().invoke


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    return record_run(tmp_path_factory.mktemp("recording"))


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    files = write_session(walking_session(), tmp_path, "xdf").files
    return files[0]


@pytest.mark.parametrize("to", sorted(SESSION_FORMATS.keys() - {"trc", "c3d"}))
def test_a_recording_is_exported(to: str, recorded: RecordedRun, tmp_path: Path) -> None:
    result = run(app, ["export", str(recorded.path), "--to", to, "--out", str(tmp_path / "new")])
    assert result.exit_code == 0, result.output
    assert [*(tmp_path / "new").iterdir()]


def test_an_exported_recording_is_what_replay_loads(recorded: RecordedRun, tmp_path: Path) -> None:
    session = load_session(recorded.path)
    assert run(app, ["export", str(recorded.path), "--to", "csv", "--out", str(tmp_path)]).output
    found = read_session(next(tmp_path.glob("*_sensors.csv")))
    assert found.start_unix_ns == session.start_unix_ns
    assert [e.kind for e in found.events] == [e.kind for e in session.events]
    assert_same_group(found.sensors, session.sensors, 1e-8)
    assert_same_group(found.segments, session.segments, 1e-8)


def test_a_file_is_converted_and_the_files_are_printed(trial: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = run(app, ["export", str(trial), "--to", "sto", "--out", str(out)])
    assert result.exit_code == 0
    printed = result.stdout.splitlines()
    assert printed == [str(out / "walk_sensors.sto"), str(out / "walk_segments.sto")]
    assert "resampled to 100 Hz by interpolation: S2" in result.stderr
    first, second = read_session(out / "walk_sensors.sto").sensors
    # The file begins when the second sensor starts, 2 ms after the first sensor, because IMUPlacer
    # needs both sensors.
    assert first.t_s[0] == pytest.approx(3.01)
    assert np.isfinite(first.orientation[0]).all()
    assert np.isfinite(second.orientation[0]).all()
    assert "IMUPlacer" not in result.stderr
    gap = (second.t_s > 3.495) & (second.t_s < 3.525)
    assert np.isnan(second.orientation[gap]).all()
    assert np.isfinite(second.orientation[second.t_s > 3.525]).all()


def test_a_wrong_path_is_not_reported_as_a_wrong_type(tmp_path: Path) -> None:
    result = run(app, ["export", str(tmp_path / "no-recording"), "--to", "csv"])
    assert result.exit_code == 2
    assert "No such file or directory" in result.output


def test_several_formats_are_written_by_one_command(trial: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["--to", "sto", "--to", "mot", "--to", "sto", "--out", str(out)]
    result = run(app, ["export", str(trial), *words])
    assert result.exit_code == 0, result.output
    assert {path.suffix for path in out.iterdir()} == {".sto", ".mot"}
    assert sorted(result.stdout.splitlines()) == sorted(map(str, out.iterdir()))


def test_sensors_are_renamed_for_opensense(trial: Path, tmp_path: Path) -> None:
    words = ["export", str(trial), "--to", "sto", "--out", str(tmp_path), "--json"]
    result = run(app, [*words, "--name", "S1=femur_r_imu"])
    files = json.loads(result.stdout)["files"]
    sensors = read_session(tmp_path / "walk_sensors.sto").sensors
    assert [(s.id, s.segment) for s in sensors] == [("femur_r_imu", "thigh"), ("S2", "shank")]
    assert len(files) == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--to", "xls"], "--to is 'xls', expected trc, c3d"),
        (["--to", "sto", "--name", "S1"], "expected ID=NAME"),
        (["--to", "sto", "--name", "S9=a"], "no sensor or segment 'S9'; did you mean"),
        (["--to", "sto", "--name", "S1=a", "--name", "S2=a"], "'a' is given twice"),
        (["--to", "xdf"], "exists: choose another folder"),
    ],
)
def test_a_wrong_command_is_refused_with_its_remedy(
    words: list[str], message: str, trial: Path
) -> None:
    before = sorted(trial.parent.iterdir())
    result = run(app, ["export", str(trial), "--out", str(trial.parent), *words])
    assert result.exit_code == 2
    assert message in result.stderr
    assert sorted(trial.parent.iterdir()) == before


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text("")
    result = run(app, ["export", str(path), "--to", "csv"])
    assert result.exit_code == 2
    assert "expected a folder or a file that ends in .trc" in result.stderr
