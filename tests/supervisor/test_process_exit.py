"""The time limit of a stop: a hanging event loop, and standard error that no process reads."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.fake_drivers import SMALLEST_RIG, install
from tests.system.station import load_factor

PROJECT = Path(__file__).resolve().parents[2]
LIMIT_S = 0.3
SHORT = f"""
import sys
import jointfit_daemon.supervisor.daemon as daemon
from jointfit_daemon.__main__ import main

daemon.STOP_S = {LIMIT_S}
sys.exit(main(["--config", sys.argv[1]]))
"""
"""Program that runs the daemon with a shorter time limit for the stop."""


def test_a_state_directory_that_can_be_written_again_is_created_and_locked(tmp_path: Path) -> None:
    install(tmp_path / "site")
    rig, blocked = tmp_path / "rig.toml", tmp_path / "blocked"
    rig.write_text(SMALLEST_RIG.format(port=1) + "health_s = 0.5\n", encoding="utf-8")
    blocked.write_text("a file, so that no folder can be created", encoding="utf-8")
    daemon = subprocess.Popen(
        [sys.executable, "-m", "jointfit_daemon", "--config", str(rig)],
        env=os.environ
        | {
            "PYTHONPATH": f"{tmp_path / 'site'}{os.pathsep}{PROJECT}",
            "STATE_DIRECTORY": str(blocked / "state"),
        },
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert daemon.stderr is not None
        for line in daemon.stderr:
            if "state directory cannot be written" in line:
                break
        blocked.unlink()
        until, lock = time.monotonic() + 60.0, blocked / "state" / "lock"
        while not (lock.exists() and lock.read_text(encoding="ascii") == f"{daemon.pid}\n"):
            assert time.monotonic() < until
            assert daemon.poll() is None
            time.sleep(0.05)
    finally:
        daemon.terminate()
        daemon.communicate()


@pytest.mark.parametrize("full_pipe", [False, True])
def test_sigterm_ends_a_daemon_whose_event_loop_hangs(tmp_path: Path, *, full_pipe: bool) -> None:
    install(tmp_path / "site")
    rig, hanging = tmp_path / "rig.toml", tmp_path / "hanging"
    sensor = f'port = "{hanging}"\nmood = "hang"'
    rig.write_text(SMALLEST_RIG.format(port=1).replace('port = "a"', sensor), encoding="utf-8")
    reading, writing = os.pipe()
    daemon = subprocess.Popen(
        [sys.executable, "-c", SHORT, str(rig)],
        env=os.environ
        | {
            "PYTHONPATH": f"{tmp_path / 'site'}{os.pathsep}{PROJECT}",
            "STATE_DIRECTORY": str(tmp_path / "state"),
        },
        stderr=writing,
    )
    try:
        until = time.monotonic() + 60.0
        while not hanging.exists():
            assert time.monotonic() < until
            time.sleep(0.02)
        if full_pipe:
            os.set_blocking(writing, False)
            while True:
                try:
                    os.write(writing, bytes(65536))
                except BlockingIOError:
                    break
            os.set_blocking(writing, True)
        began = time.monotonic()
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(timeout=60.0) == 1
        assert time.monotonic() - began < (LIMIT_S + 1.0) * load_factor()
    finally:
        daemon.kill()
        daemon.wait()
        os.close(writing)
        with os.fdopen(reading, "rb") as pipe:
            said = pipe.read()
    assert full_pipe or b"the stop did not end within 0.3 s: exiting" in said


def test_a_closed_pipe_ends_the_check_without_a_traceback(tmp_path: Path) -> None:
    rig = Path(__file__).parents[2] / "examples" / "self-described.toml"
    check = f"{sys.executable} -m jointfit_daemon --config {rig} --check"
    script = f"{check} | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(
        ["/bin/bash", "-c", script], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert (done.returncode, done.stderr) == (0, "")
