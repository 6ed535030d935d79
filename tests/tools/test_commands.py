"""All commands print results on stdout and faults with a remedy on stderr, and set exit codes."""

from __future__ import annotations

import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import orjson
import pytest
from typer.main import get_command
from typer.testing import CliRunner

from jointfit_daemon import __version__
from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.command_group import ON_DEMAND_ERRORS, join_lines
from jointfit_variant import running_variant

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "knee.toml"
COMPLETION = EXAMPLE.parents[1] / "packaging" / "completions" / "jointfit.bash"
run = CliRunner().invoke


def test_the_version_is_the_packages_and_its_variant_is_named() -> None:
    expected = f"{__version__} ({running_variant()})"
    assert run(app, ["--version"]).stdout.strip() == expected


@pytest.mark.parametrize("command", sorted(get_command(app).commands))  # type: ignore[attr-defined]  # it is a group
def test_every_command_explains_itself(command: str) -> None:
    result = run(app, [command, "--help"])
    assert result.exit_code == 0
    assert "Usage" in result.stdout


def test_help_paragraphs_are_wrapped_by_the_terminal_only() -> None:
    text = "One\ntwo.\n\nThree\nfour.\n\n- five\n- six"
    assert join_lines(text) == "One two.\n\nThree four.\n\n- five\n- six"
    shown = get_command(app).get_command(None, "doctor")  # type: ignore[attr-defined]
    assert all("\n" not in paragraph for paragraph in shown.help.split("\n\n"))


NO_JSON = {
    "dashboard": "serves until it is stopped",
    "decode": "--jsonl and --summary print JSON",
    "demo": "--headless prints one JSON line",
    "fuse": "its commands have the option",
    "monitor": "is a screen",
    "schema": "prints JSON only",
}


@pytest.mark.parametrize("command", sorted(get_command(app).commands))  # type: ignore[attr-defined]  # it is a group
def test_every_command_with_a_result_prints_it_as_json_on_request(command: str) -> None:
    found = get_command(app).get_command(None, command)  # type: ignore[attr-defined]
    options = {option for parameter in found.params for option in parameter.opts}
    assert ("--json" in options) != (command in NO_JSON)


def completions(*words: str) -> list[str]:
    """Return the completions that bash offers if the user types `words` and the Tab key."""
    line = " ".join(map(shlex.quote, ("jointfit", *words)))
    script = f"""
        . {COMPLETION}
        COMP_WORDS=({line}) COMP_CWORD={len(words)}
        _jointfit_completion jointfit
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    environment = {"PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin"}
    command = ["bash", "--norc", "-c", script]
    return subprocess.check_output(command, text=True, env=environment).split()


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["cal"], ["calibrate"]),
        (["calibrate", "--phase", "st"], ["static"]),
        (["decode", "natn"], ["natnet"]),
        (["request", "self"], ["selftest"]),
        (["schema", "bridge/request/mar"], ["bridge/request/mark"]),
        (["demo", "--limb", "ar"], ["arm"]),
        (["check", "--js"], ["--json"]),
        (["calibrate", "se"], ["sensor"]),
        (["calibrate", "sensor", "--reco"], ["--recording"]),
        (["fuse", "ap"], ["apply"]),
    ],
)
def test_bash_completes_commands_options_and_their_values(
    words: list[str], offered: list[str]
) -> None:
    assert completions(*words) == offered


def test_bash_completes_the_sensors_and_files_of_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text('[[imu]]\nid = "S1"\n[[imu]]\nid = "T1"\n')
    (tmp_path / "seat.toml").write_text("")
    assert completions("calibrate", "sensor", "T") == ["T1"]
    assert completions("calibrate", "se") == ["sensor", "seat.toml"]
    assert completions("calibrate", "rig") == []  # bash completes the path
    steps = ("--steps", "gyroscope,acc")
    assert completions("calibrate", "sensor", "S1", *steps) == ["gyroscope,accelerometer"]


def test_the_packaged_completion_is_what_the_command_line_prints() -> None:
    environment = {"_JOINTFIT_COMPLETE": "source_bash"}
    printed = run(app, [], env=environment, prog_name="jointfit").stdout
    assert COMPLETION.read_text(encoding="utf-8").split() == printed.split()


@pytest.mark.parametrize(("module", "name"), [row[1:] for row in ON_DEMAND_ERRORS])
def test_every_error_that_commands_report_is_importable(module: str, name: str) -> None:
    assert issubclass(getattr(importlib.import_module(module), name), Exception)


def test_the_example_rig_is_right_and_its_sources_are_listed() -> None:
    result = run(app, ["check", str(EXAMPLE)])
    assert re.search(r"mocap .* its own", result.stdout)  # Motive sets the rate of the cameras
    assert result.exit_code == 0
    for name in ("S1", "S2", "S3", "S4", "mocap"):
        assert name in result.stdout


def test_invalid_rig_is_reported_with_every_fault_and_exit_code_2(tmp_path: Path) -> None:
    wrong = tmp_path / "rig.toml"
    text = EXAMPLE.read_text("utf-8")
    wrong.write_text(text.replace('driver = "xbus"', 'driver = "xbuz"').replace("baud =", "bawd ="))
    result = run(app, ["check", str(wrong)])
    assert result.exit_code == 2
    assert "xbus" in result.stderr


def test_check_speaks_json_to_programs(tmp_path: Path) -> None:
    assert orjson.loads(run(app, ["check", str(EXAMPLE), "--json"]).stdout)["ok"] is True
    missing = run(app, ["check", str(tmp_path / "none.toml"), "--json"])
    assert missing.exit_code == 2
    assert orjson.loads(missing.stdout)["ok"] is False


def test_the_schema_names_the_keys_of_rig_and_drivers() -> None:
    text = run(app, ["schema"]).stdout
    schema = orjson.loads(text)
    assert schema["properties"]["rig"]
    for key in ("output_rate_hz", "reset_if_stuck", "sample_time_unit", "up_axis"):
        assert key in text


def test_calibrate_without_a_broker_reports_its_address(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    text = EXAMPLE.read_text("utf-8").replace('host = "127.0.0.1"', 'host = "127.0.0.1"\nport = 9')
    rig.write_text(text)
    result = run(app, ["calibrate", str(rig), "--yes", "--phase", "static"])
    assert result.exit_code == 1
    assert "127.0.0.1:9" in result.stderr


def test_an_unknown_phase_is_refused_before_anything_is_sent() -> None:
    result = run(app, ["calibrate", str(EXAMPLE), "--phase", "dance"])
    assert result.exit_code == 2
    assert "functional" in result.stderr


@pytest.mark.parametrize(("kept", "code"), [("knee: flexion error 5 deg, was 2", 3), (None, 0)])
def test_a_result_that_is_not_taken_ends_with_3_and_the_reason(
    monkeypatch: pytest.MonkeyPatch, kept: str | None, code: int
) -> None:
    async def led(*_: object, **__: object) -> dict[str, object]:
        return {"text": "told", "kept": kept, "quality": {}}

    monkeypatch.setattr("jointfit_daemon.tools.calibrate._command._guide_phases", led)
    result = run(app, ["calibrate", str(EXAMPLE), "--yes"])
    assert result.exit_code == code
    assert "told" in result.stdout
    assert (kept or "") in result.stderr


def test_help_does_not_load_the_metadata_of_packages() -> None:
    code = (
        "import sys, jointfit_daemon.__main__, jointfit_daemon.tools.__main__;"
        "print('importlib.metadata' in sys.modules)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "False"
