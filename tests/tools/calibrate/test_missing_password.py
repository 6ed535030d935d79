"""`jointfit calibrate` refuses wrong durations, and names a missing password file of the broker."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

from jointfit_daemon.tools.__main__ import app
from tests import fake_drivers

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("seconds", ["601", "0", "nan"])
def test_a_duration_outside_of_its_range_is_refused_with_the_range(seconds: str) -> None:
    result = CliRunner().invoke(app, ["calibrate", "--phase", "static", "--seconds", seconds])
    assert result.exit_code == 2
    assert "expected 0 < seconds <= 600" in result.output + str(result.exception)


def test_a_missing_password_file_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jointfit_daemon.driver.entry_points", fake_drivers.entry_points)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    rig = tmp_path / "rig.toml"
    login = 'username = "leg"\npassword_file = "secret"\n'
    rig.write_text(fake_drivers.SMALLEST_RIG.format(port=port) + login, encoding="utf-8")
    result = CliRunner().invoke(app, ["calibrate", str(rig), "--abort"])
    assert result.exit_code == 1
    note, refused = result.stderr.splitlines()
    assert note == (
        f"jointfit calibrate: user 'leg' has no password: password_file = {tmp_path}/secret: No "
        "such file or directory. Create the file, or correct [mqtt]; connecting without a password"
    )
    assert "connection refused" in refused
