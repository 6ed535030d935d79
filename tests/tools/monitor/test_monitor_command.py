"""`jointfit monitor` applies its options, and reports faults before the screen opens."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.monitor._command import _broker_settings, shows_unicode

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = ROOT / "examples" / "knee.toml"
run = CliRunner().invoke


def test_without_a_terminal_the_remedy_is_named() -> None:
    result = run(app, ["monitor", "--broker", "localhost"])
    assert result.exit_code == 2
    assert "not a terminal: use ssh -t" in result.stderr


def test_without_textual_the_pip_command_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "jointfit_daemon.tools.monitor._app", raising=False)
    monkeypatch.setitem(sys.modules, "textual.app", None)
    monkeypatch.setattr("jointfit_daemon.tools.monitor._command._has_terminal", lambda: True)
    result = run(app, ["monitor", "--broker", "localhost"])
    assert result.exit_code == 2
    assert "pip install 'jointfitd[monitor]'" in result.stderr


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--broker", "http://host"], "expected mqtt://HOST:PORT"),
        (["--broker", "wss://host/mqtt"], "no WebSocket address"),
        (["--broker", "mqtt://me:" + "secret@host"], "use --user and --password-file"),
        (["--broker", "mqtt://-host-"], "--broker"),
        (["--ca", "ca.crt", "--broker", "mqtt://host"], "mqtts://HOST only"),
        (["--user", "viewer"], "--user and --password-file: expected both"),
        (["--user", "viewer", "--password-file", "none"], "none: No such file"),
        (["--request-key-file", "none"], "none: No such file"),
        (["--rig", str(EXAMPLE), "--broker", "localhost"], "exclude each other"),
        (["--rig", "none.toml"], "none.toml"),
        (["--rate", "11"], "--rate"),
    ],
)
def test_faulty_options_are_named_with_what_was_expected(
    options: list[str], expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(app, ["monitor", *options], env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert expected in result.stderr
    assert "secret" not in result.stderr


def test_an_empty_password_file_is_reported(tmp_path: Path) -> None:
    (tmp_path / "p").write_text("\n")
    result = run(app, ["monitor", "--user", "viewer", "--password-file", str(tmp_path / "p")])
    assert result.exit_code == 2
    assert "the file contains no password" in result.stderr


def test_account_tls_and_key_are_those_of_the_options(tmp_path: Path) -> None:
    for name in ("ca", "password", "key"):
        (tmp_path / name).write_text("secret content")
    settings = _broker_settings(
        "mqtts://broker.lab", base="/lab/leg/", ca=tmp_path / "ca", user="viewer",
        password_file=tmp_path / "password", request_key_file=tmp_path / "key",
    )  # fmt: skip
    assert (settings.host, settings.tcp_port, settings.base) == ("broker.lab", 8883, "lab/leg")
    assert settings.tls is not None
    assert settings.tls.ca == str(tmp_path / "ca")
    assert settings.username == "viewer"
    assert settings.request_key_file == str(tmp_path / "key")


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, True),
        ({"LANG": "de_DE.UTF-8", "TERM": "xterm-256color"}, True),
        ({"LANG": "en_US.utf8"}, True),
        ({"LANG": "C", "LC_CTYPE": "C.UTF-8"}, False),
        ({"LANG": "C.UTF-8", "LC_ALL": "POSIX"}, False),
        ({"LANG": "C.UTF-8", "TERM": "linux"}, False),
    ],
)
def test_unicode_follows_terminal_and_locale(environment: dict[str, str], expected: bool) -> None:
    assert shows_unicode(environment) is expected
