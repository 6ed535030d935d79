"""`jointfit batch` writes the same files as the single commands.

A fault affects one recording only, and a killed batch can be continued.
"""

from __future__ import annotations

import csv
import html
import os
import re
import signal
import subprocess
import sys
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING

import orjson
import pytest
from typer.testing import CliRunner

from jointfit_daemon.outputs.recording._blocks import ChunkBlock, read_blocks
from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.batch import executors
from jointfit_daemon.tools.batch.executors import run_in_pool
from jointfit_daemon.tools.batch.find_recordings import find_recordings
from jointfit_daemon.tools.batch.recording_task import (
    RecordingResult,
    RecordingTask,
    finished_result,
    process_recording,
    task_digest,
)
from tests.tools.batch.deadly_task import process_or_die

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Recordings = Callable[[int], Path]

run = CliRunner().invoke
DO = ["--do", "export,report", "--to", "csv,mot"]


def files_of(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files by relative path, except the marks of finished recordings."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and ".done" not in path.parts
    }


def rows_of(out: Path) -> list[dict[str, str]]:
    with (out / "summary.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def task_of(path: Path, out: Path, *steps: str) -> RecordingTask:
    name = path.name.partition(".")[0]
    return RecordingTask(name, (str(path),), str(out), steps or ("export", "report"), ("csv",))


def test_batch_equals_single_commands_byte_for_byte(recordings: Recordings, tmp_path: Path) -> None:
    folder, single = recordings(2), tmp_path / "single"
    result = run(app, ["batch", str(folder), *DO, "--jobs", "1", "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    for path in sorted(folder.iterdir()):
        own = single / path.name.partition(".")[0]
        for name in ("csv", "mot"):
            arguments = ["export", str(path), "--to", name, "--out", str(own)]
            assert run(app, arguments).exit_code == 0
        page = own / "report.html"
        assert run(app, ["report", str(path), "--out", str(page)]).exit_code == 0
        assert files_of(tmp_path / "out" / own.name) == files_of(own)


def test_calibration_and_replay_equal_the_single_commands(
    recordings: Recordings, tmp_path: Path
) -> None:
    (path,), out = recordings(1).iterdir(), tmp_path / "out"
    arguments = ["batch", str(path.parent), "--do", "replay,calibrate,report", "--jobs", "1"]
    assert run(app, [*arguments, "--out", str(out)]).exit_code == 0
    (row,) = rows_of(out)
    assert "equal, byte for byte" in row["verified"]

    own = tmp_path / "own.json"
    assert run(app, ["calibrate", "--recording", str(path), "--out", str(own)]).exit_code == 0
    assert (out / "trial-0000" / "calibration.json").read_bytes() == own.read_bytes()


def test_one_bad_file_stops_only_itself(recordings: Recordings, tmp_path: Path) -> None:
    folder, out = recordings(2), tmp_path / "out"
    (folder / "trial-0000a.mcap").write_bytes(b"not a recording")
    result = run(app, ["batch", str(folder), "--jobs", "1", "--out", str(out), "--json"])
    assert result.exit_code == 1
    rows = rows_of(out)
    assert [row["status"] for row in rows] == ["done", "failed", "done"]
    printed = orjson.loads(result.stdout)["recordings"]
    assert [row["status"] for row in printed] == ["done", "failed", "done"]
    assert printed[1]["error"] == rows[1]["error"]
    assert "trial-0000a.mcap" in rows[1]["error"]
    assert float(rows[0]["duration_s"]) > 0.0
    assert not (out / "trial-0000a").exists()
    page = (out / "summary.html").read_text("utf-8")
    assert "▲ failed" in page
    assert 'href="trial-0000/report.html"' in page


def test_the_row_of_a_damaged_recording_names_its_gap(
    recordings: Recordings, tmp_path: Path
) -> None:
    (path,), out = recordings(1).iterdir(), tmp_path / "out"
    content = bytearray(path.read_bytes())
    chunk = [block for block in read_blocks(path) if isinstance(block, ChunkBlock)][-1]
    content[chunk.end - 100] ^= 1
    path.write_bytes(content)
    arguments = ["batch", str(path.parent), "--do", "replay,report", "--jobs", "1"]
    assert run(app, [*arguments, "--out", str(out)]).exit_code == 0

    (row,) = rows_of(out)
    assert "cannot be compared because of the gap" in row["verified"]
    assert re.match(r"at [\d.]+ s: \d+ messages .* are missing: bytes .* are damaged", row["gaps"])
    assert html.escape(row["gaps"]) in (out / "summary.html").read_text("utf-8")


def test_finished_recordings_are_not_processed_again(
    recordings: Recordings, tmp_path: Path
) -> None:
    folder, out = recordings(2), tmp_path / "out"
    arguments = ["batch", str(folder), "--jobs", "1", "--out", str(out)]
    assert run(app, arguments).exit_code == 0
    before = {p: p.stat().st_mtime_ns for p in out.rglob("report.html")}
    summary = (out / "summary.csv").read_bytes()

    assert run(app, arguments).exit_code == 0
    assert {p: p.stat().st_mtime_ns for p in out.rglob("report.html")} == before
    assert (out / "summary.csv").read_bytes() == summary

    # With other steps, the recordings are processed again.
    assert run(app, [*arguments, "--do", "export"]).exit_code == 0
    assert not list(out.rglob("report.html"))


def test_a_result_counts_for_the_same_bytes_and_with_its_files_only(
    recordings: Recordings, tmp_path: Path
) -> None:
    """A result is reused only if the recording is unchanged, and mark and output files exist."""
    (path,) = recordings(1).iterdir()
    task = task_of(path, tmp_path / "out", "report")
    process_recording(task)
    digest = task_digest(task)
    assert finished_result(task, digest) is not None

    mark = tmp_path / "out" / ".done" / "trial-0000.json"
    whole = mark.read_bytes()
    mark.write_bytes(whole[:50])
    assert finished_result(task, digest) is None
    mark.write_bytes(whole)

    with path.open("ab") as file:
        file.write(b"\n")
    assert task_digest(task) != digest
    (tmp_path / "out" / "trial-0000").rename(tmp_path / "moved")
    assert finished_result(task, digest) is None


def test_outputs_of_a_failed_recording_leave_nothing_and_replace_nothing(
    recordings: Recordings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (path,) = recordings(1).iterdir()
    out = tmp_path / "out"
    process_recording(task_of(path, out, "report"))
    before = files_of(out)

    def fail(_: object) -> str:
        raise MemoryError("too long")

    monkeypatch.setattr("jointfit_daemon.tools.report.page.render_report", fail)
    result = process_recording(task_of(path, out, "export", "report"))
    assert result.status == "failed"
    assert "MemoryError: too long" in result.error
    assert files_of(out) == before


def test_parts_of_a_session_are_one_recording(tmp_path: Path) -> None:
    names = [
        "a-20261123T091420-0001.mcap", "a-20261123T091420-0002.mcap.part", "b.mcap",
        "sub/a-20261123T091420-0001.mcap", "batch/x.mcap", ".hidden/y.mcap", "notes.txt",
    ]  # fmt: skip
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    tasks = find_recordings(tmp_path, tmp_path / "batch", ("report",), ())
    assert [(task.name, len(task.parts)) for task in tasks] == [
        ("a-20261123T091420", 2), ("b", 1), ("sub/a-20261123T091420", 1),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--do", "reprot"], "--do"),
        (["--do", "export", "--to", "xls"], "--to"),
        (["--scheduler", "tcp://127.0.0.1:1", "--jobs", "2"], "--jobs"),
        ([], "no recording"),
    ],
)
def test_wrong_options_are_named(tmp_path: Path, arguments: list[str], named: str) -> None:
    result = run(app, ["batch", str(tmp_path), *arguments])
    assert result.exit_code == 2
    assert named in result.stderr
    assert list(tmp_path.iterdir()) == []


class BreakingPool:
    """Pool that breaks at the submission of the fifth task; the results of four tasks are ready."""

    def __init__(self, *_: object) -> None:
        self.submitted = 0

    def __enter__(self) -> BreakingPool:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def submit(
        self, work: Callable[[RecordingTask], RecordingResult], task: RecordingTask
    ) -> Future[RecordingResult]:
        self.submitted += 1
        if self.submitted > 4:
            raise BrokenProcessPool
        done: Future[RecordingResult] = Future()
        done.set_result(work(task))
        return done


def test_no_recording_is_lost_if_the_pool_breaks_at_a_submission(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(executors, "ProcessPoolExecutor", BreakingPool)
    monkeypatch.setattr(executors, "process_recording", process_or_die)
    tasks = [RecordingTask(name, (), str(tmp_path), ("report",), ()) for name in "abcdef"]
    assert sorted(result.recording for result in run_in_pool(tasks, 2)) == [*"abcdef"]


@pytest.mark.system
def test_a_process_that_dies_fails_only_its_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(executors, "process_recording", process_or_die)
    names = ["a", "b", "deadly", "c", "d"]
    tasks = [RecordingTask(name, (), str(tmp_path), ("report",), ()) for name in names]
    results = {result.recording: result for result in run_in_pool(tasks, 2)}
    assert sorted(results) == sorted(names)
    assert {name for name, result in results.items() if result.status == "done"} == {*"abcd"}
    assert "memory" in results["deadly"].error


@pytest.mark.system
@pytest.mark.experiment
def test_a_killed_batch_continues_and_gives_the_same_files(
    recordings: Recordings, tmp_path: Path
) -> None:
    folder, out = recordings(4), tmp_path / "out"
    command = [
        sys.executable, "-m", "jointfit_daemon.tools", "batch", str(folder), "--jobs", "1", "--out",
    ]  # fmt: skip
    killed = subprocess.Popen(
        [*command, str(out)], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert killed.stderr is not None
    with killed, killed.stderr:
        assert "done" in killed.stderr.readline()
        os.killpg(killed.pid, signal.SIGKILL)
    assert not (out / "summary.csv").exists()
    finished = {path: path.stat().st_mtime_ns for path in out.glob("trial-*/report.html")}
    assert finished

    subprocess.run([*command, str(out)], check=True, capture_output=True)
    kept = {path: path.stat().st_mtime_ns for path in finished}
    assert set(kept.items()) & set(finished.items())
    subprocess.run([*command, str(tmp_path / "whole")], check=True, capture_output=True)
    found = {n: b for n, b in files_of(out).items() if not n.startswith(".partial")}
    assert found == files_of(tmp_path / "whole")
