"""`jointfit report` writes the page of a recording, and leaves an older page after a failure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import orjson
from typer.testing import CliRunner

from jointfit_daemon.tools.__main__ import app

if TYPE_CHECKING:
    from pathlib import Path

run = CliRunner().invoke


def test_page_of_a_recording_is_written(recorded: Path, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    result = run(app, ["report", str(recorded), "--out", str(page)])
    assert result.exit_code == 0, result.output
    assert f"wrote {page}" in result.stderr
    text = page.read_text("utf-8")
    assert "Joint angles" in text
    assert "first step" in text
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    again = run(app, ["report", str(recorded), "--out", str(page), "--json"])
    assert orjson.loads(again.stdout) == {"file": str(page)}


def test_a_file_that_is_no_recording_leaves_no_page(tmp_path: Path) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"not a recording")
    result = run(app, ["report", str(broken), "--out", str(tmp_path / "report.html")])
    assert result.exit_code == 2
    assert "broken.mcap" in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["broken.mcap"]


def test_an_older_page_survives_a_failure(recorded: Path, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    page.write_text("older", "utf-8")
    assert run(app, ["report", str(tmp_path / "absent.mcap"), "--out", str(page)]).exit_code == 2
    assert page.read_text("utf-8") == "older"
    assert run(app, ["report", str(recorded), "--out", str(page)]).exit_code == 0
    assert page.read_text("utf-8") != "older"


def test_another_ending_is_refused(recorded: Path) -> None:
    result = run(app, ["report", str(recorded), "--out", "report.pdf"])
    assert result.exit_code == 2
    assert ".html" in result.stderr
