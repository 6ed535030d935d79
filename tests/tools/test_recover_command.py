"""`jointfit recover` writes a clean file, lists the gaps, and does not change the damaged file."""

from __future__ import annotations

from typing import TYPE_CHECKING

import orjson
import pytest
from typer.testing import CliRunner

from jointfit_daemon.outputs.recording import read_events
from jointfit_daemon.pipeline.events import Tick
from jointfit_daemon.tools.__main__ import app
from tests.outputs.recording.recorded_events import write_recording

if TYPE_CHECKING:
    from pathlib import Path

    from typer.testing import Result


def recover(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["recover", *map(str, arguments)])


def test_an_unfinished_file_gets_its_final_name(tmp_path: Path) -> None:
    whole = write_recording(tmp_path, map(Tick, range(1000)))
    torn = whole.rename(whole.with_name(f"{whole.name}.part"))
    content = torn.read_bytes()
    torn.write_bytes(content[: content.index(b"jointfit.end")])
    result = recover(torn)
    assert result.exit_code == 0, result.output
    assert (
        "the recording was not closed: messages of its last second may be missing" in result.output
    )
    assert f"{whole}: 1000 messages" in result.output
    assert list(read_events(whole)) == [*map(Tick, range(1000))]
    assert torn.exists()


def test_a_damaged_chunk_is_listed(tmp_path: Path) -> None:
    path = write_recording(tmp_path, map(Tick, range(1000)))
    damaged = bytearray(path.read_bytes())
    damaged[damaged.index(b"\x28\xb5\x2f\xfd") + 50] ^= 4
    path.write_bytes(damaged)
    result = recover(path, "--out", tmp_path / "new.mcap")
    assert result.exit_code == 0, result.output
    assert "500 messages (0 to 499" in result.output
    assert "bytes" in result.output
    assert len(list(read_events(tmp_path / "new.mcap"))) == 500


def test_a_program_gets_the_gaps_as_json(tmp_path: Path) -> None:
    path = write_recording(tmp_path, map(Tick, range(1000)))
    damaged = bytearray(path.read_bytes())
    damaged[damaged.index(b"\x28\xb5\x2f\xfd") + 50] ^= 4
    path.write_bytes(damaged)
    found = orjson.loads(recover(path, "--json").stdout)
    assert found["file"] == str(path.with_name(f"{path.stem}-clean.mcap"))
    assert found["messages"] == 500
    assert found["closed"]
    assert found["unreadable_bytes"] > 0
    assert [(gap["first"], gap["count"]) for gap in found["gaps"]] == [(0, 500)]


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89MCAP0\r\n"])
def test_other_files_are_refused_and_leave_nothing(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    result = recover(path)
    assert result.exit_code == 2
    assert "a.mcap" in result.output
    assert list(tmp_path.iterdir()) == [path]


def test_an_existing_copy_is_not_overwritten(tmp_path: Path) -> None:
    path = write_recording(tmp_path, [Tick(1)])
    path.with_name(f"{path.stem}-clean.mcap").write_text("mine")
    result = recover(path)
    assert result.exit_code == 2
    assert "--out" in result.output
