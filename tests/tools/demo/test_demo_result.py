"""The demo always ends with a result line, even after a failed step or Ctrl-C."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from typing import TYPE_CHECKING, Any

import orjson
import pytest
from typer.testing import CliRunner

from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.demo._command import result_line
from tests.system.station import PATIENCE_S, restore_signals

if TYPE_CHECKING:
    from pathlib import Path

FIGURES: dict[str, Any] = {
    "knee_flexion_rmse_deg": 1.83,
    "frames": 3000,
    "joint_center_error_mm": 12.5,
    "latency_ms": {"p50": 3.1, "p99": 9.8},
    "samples": {"received": 23990},
    "sent": 24000,
    "unaccounted": 0,
    "corrupt": 0,
}


def test_the_result_line_has_errors_latency_and_samples() -> None:
    line = result_line("passed", FIGURES)
    assert line.startswith("result: passed; knee flexion error 1.83° RMS over 3000 frames")
    for part in ("12.5 mm", "3.1 ms median", "9.8 ms p99", "24000 sent", "0 unaccounted for"):
        assert part in line
    assert "\n" not in line


def test_result_line_marks_missing_values_as_unknown() -> None:
    line = result_line("interrupted by SIGINT", {})
    assert "knee flexion error unknown RMS" in line
    assert "None" not in line


@pytest.mark.parametrize("headless", [True, False])
def test_a_complete_run_ends_with_its_result_line(
    monkeypatch: pytest.MonkeyPatch, *, headless: bool
) -> None:
    async def ran(*_: object, **__: object) -> tuple[dict[str, Any], None]:
        return dict(FIGURES), None

    monkeypatch.setattr("jointfit_daemon.tools.demo._command._run", ran)
    result = CliRunner().invoke(app, ["demo", *(["--headless"] if headless else [])])
    assert result.exit_code == 0
    assert (result.stderr if headless else result.stdout).splitlines()[-1].startswith("result:")


@pytest.mark.system
def test_failed_step_ends_with_a_result_line_and_its_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("jointfit_daemon.tools.demo._run.CONNECT_S", 0.01)
    result = CliRunner().invoke(app, ["demo", "--headless"])
    assert result.exit_code == 1
    assert "result: failed; " in result.stderr
    (reason,) = orjson.loads(result.stdout.splitlines()[-1])["missed"]
    assert "connecting all sources took longer" in reason


@pytest.mark.system
@pytest.mark.timeout(180)
@pytest.mark.parametrize("options", [["--headless"], []])
async def test_ctrl_c_ends_the_demo_with_a_result_line(tmp_path: Path, options: list[str]) -> None:
    """The signal goes to the whole process group, as a terminal sends it."""
    pytest.importorskip("iotcore", reason="iotcore is not installed (pip install jointfitd[demo])")
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "jointfit_daemon.tools", "demo", "--keep", str(tmp_path), *options),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        start_new_session=True,
        preexec_fn=restore_signals,
    )
    async with asyncio.timeout(2 * PATIENCE_S):
        while not (tmp_path / "rig.toml").exists():
            await asyncio.sleep(0.05)
        await asyncio.sleep(1.0)  # the daemon is starting
        os.killpg(process.pid, signal.SIGINT)
        output, _ = await process.communicate()
    process._transport.close()  # type: ignore[attr-defined]  # asyncio does not close it
    assert process.returncode == 128 + signal.SIGINT, output.decode()
    assert output.decode().splitlines()[-1].startswith("result: interrupted by SIGINT;")
    assert b"Traceback" not in output
