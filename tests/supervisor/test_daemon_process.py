"""The daemon as a process: output, exit codes, files, and final messages at the broker."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon import __version__
from jointfit_daemon.__main__ import main
from jointfit_daemon.calibration.record._store import checksum
from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs.mqtt import MqttClient
from jointfit_daemon.outputs.recording import (
    encode_state,
    open_recording,
    read_events,
)
from jointfit_daemon.pipeline.events import Configured
from tests import fake_drivers
from tests.limb_model.plain_calibration import plain_calibration
from tests.pipeline.core_feed import replay_states
from tests.system.station import load_factor

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.broker_fixture import Broker

PROJECT = Path(__file__).resolve().parents[2]
PATIENCE_S = 60.0
"""Time limit for a step, s. On an idle machine, a step takes a second."""

pytestmark = pytest.mark.system

RIG = """
[rig]
name = "bench"
[chain]
joints = ["hip", "knee", "ankle"]
segments = ["thigh", "shank"]
[[imu]]
id = "S1"
segment = "thigh"
driver = "fake"
port = "a"
[[imu]]
id = "S2"
segment = "shank"
driver = "fake"
port = "b"
mood = "{mood}"
[mqtt]
host = "127.0.0.1"
port = {port}
[recording]
"""


class Process:
    """One jointfitd process with the simulated drivers installed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        fake_drivers.install(folder / "site")
        self.rig = folder / "rig.toml"
        self.state = folder / "state"

    def write(self, port: int, mood: str = "well") -> None:
        self.rig.write_text(RIG.format(port=port, mood=mood), encoding="utf-8")

    def start(self, *more: str, **environment: str) -> subprocess.Popen[str]:
        paths = os.pathsep.join([str(self._folder / "site"), str(PROJECT)])
        return subprocess.Popen(
            [sys.executable, "-m", "jointfit_daemon", "--config", str(self.rig), *more],
            env=os.environ
            | {"PYTHONPATH": paths, "STATE_DIRECTORY": str(self.state)}
            | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )


@pytest.fixture
def process(tmp_path: Path) -> Process:
    return Process(tmp_path)


@contextlib.contextmanager
def running(process: Process, **environment: str) -> Iterator[subprocess.Popen[str]]:
    started = process.start(**environment)
    try:
        yield started
    finally:
        if started.poll() is None:
            started.kill()
        started.communicate()


async def states(port: int, count: int) -> list[dict[str, Any]]:
    """Return `count` poses that the daemon publishes."""
    settings = MqttSettings(host="127.0.0.1", port=port, base="jointfit/bench")
    found = []
    async with asyncio.timeout(PATIENCE_S), MqttClient(settings) as client:
        await client.subscribe("pose")
        async for _, pose in client.messages():
            found.append(pose)
            if len(found) >= count:
                break
    return found


async def test_daemon_log_replays_to_byte_identical_states(
    process: Process, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    process.write(broker.port)
    with running(process) as daemon:
        assert len(await states(broker.port, 30)) == 30
        daemon.send_signal(signal.SIGHUP)
        assert len(await states(broker.port, 30)) == 30
        began = time.monotonic()
        daemon.send_signal(signal.SIGTERM)
        _, said = await asyncio.to_thread(daemon.communicate)
        assert daemon.returncode == 0, said
    assert time.monotonic() - began < 5 * load_factor()
    assert "reloaded" in said
    assert "Traceback" not in said
    monkeypatch.setattr("jointfit_daemon.driver.entry_points", fake_drivers.entry_points)
    (log,) = (process.state / "recordings").iterdir()
    live = list(open_recording(log).states())
    replayed = [encode_state(state) for state in replay_states(read_events(log))]
    assert len(live) >= 60
    assert replayed == live


def test_unexpected_error_ends_the_daemon_with_a_traceback_and_exit_code_1(
    process: Process,
) -> None:
    process.write(1, mood="bug")
    with running(process) as daemon:
        _, said = daemon.communicate(timeout=PATIENCE_S)
    assert daemon.returncode == 1
    assert "ZeroDivisionError: a bug" in said


async def test_a_disk_without_room_stops_neither_poses_nor_later_recording(
    process: Process, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    process.write(broker.port)
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with running(process) as daemon:
        assert len(await states(broker.port, 20)) == 20
        for room_bytes in (0, *random.Random(4).sample(range(20_000), 3)):
            resource.prlimit(daemon.pid, resource.RLIMIT_FSIZE, (room_bytes, hard))
            assert len(await states(broker.port, 60)) == 60
        resource.prlimit(daemon.pid, resource.RLIMIT_FSIZE, (hard, hard))
        assert len(await states(broker.port, 150)) == 150
        daemon.send_signal(signal.SIGTERM)
        _, said = await asyncio.to_thread(daemon.communicate)
        assert daemon.returncode == 0, said
    assert "recording is interrupted" in said
    assert "recording resumed" in said
    monkeypatch.setattr("jointfit_daemon.driver.entry_points", fake_drivers.entry_points)
    recording = open_recording(process.state / "recordings")
    assert recording.gaps()
    assert len(list(recording.states())) > 100


def read_log(daemon: subprocess.Popen[str], part: str) -> str:
    """Return the log up to the next line that contains `part`."""
    assert daemon.stderr is not None
    lines = []
    for line in daemon.stderr:
        lines.append(line)
        if part in line:
            break
    else:
        raise AssertionError(f"ended without {part!r}: {''.join(lines)}")
    return "".join(lines)


def wait_for(path: Path) -> None:
    until = time.monotonic() + PATIENCE_S
    while not path.exists():
        assert time.monotonic() < until, f"{path} does not appear"
        time.sleep(0.02)


def test_a_second_daemon_in_one_state_directory_ends_with_exit_code_3(process: Process) -> None:
    process.write(1)
    with running(process) as first:
        wait_for(process.state / "recordings")
        with running(process) as second:
            _, said = second.communicate(timeout=PATIENCE_S)
        assert second.returncode == 3
        assert f"used by another jointfitd (process {first.pid})" in said
        assert "Traceback" not in said
        assert first.poll() is None
        first.kill()
        first.wait()
    with running(process) as third:  # the lock is released
        time.sleep(1)
        assert third.poll() is None


def test_reloads_of_hostile_files_change_nothing(process: Process) -> None:
    process.write(1)
    hostile = [
        b"a = " + b"[" * 5000,
        b'[rig]\nname = "a\\u0000"\n',
        b"\xff\xfe",
        b"x = 1" + b"0" * 5000,
        b".".join([b"a"] * 3000) + b" = 1",
    ]
    refused = "refused, the running configuration stays in force"
    with running(process) as daemon:
        log = read_log(daemon, ": running, ")
        for content in hostile:
            process.rig.write_bytes(content)
            daemon.send_signal(signal.SIGHUP)
            log += read_log(daemon, refused)
            assert daemon.poll() is None
        process.rig.unlink()
        os.mkfifo(process.rig)
        daemon.send_signal(signal.SIGHUP)
        log += read_log(daemon, refused)
        daemon.send_signal(signal.SIGTERM)
        _, rest = daemon.communicate(timeout=PATIENCE_S)
    said = log + rest
    assert daemon.returncode == 0, said
    assert said.count(refused) == len(hostile) + 1
    assert "Traceback" not in said


@pytest.mark.parametrize(
    "content",
    [b"a = " + b"[" * 5000, b'[rig]\nname = "a\\u0000"', b"\xff\xfe", b"a = " + b"1" * 5000],
)
def test_a_start_with_a_hostile_file_is_a_clear_message(process: Process, content: bytes) -> None:
    process.rig.write_bytes(content)
    with running(process) as daemon:
        _, said = daemon.communicate(timeout=PATIENCE_S)
    assert daemon.returncode == 2
    assert "Traceback" not in said
    assert str(process.rig) in said


def test_damaged_calibrations_are_set_aside_and_the_newest_valid_one_is_used(
    process: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    chain = SimpleNamespace(
        joints=("hip", "knee", "ankle"), segments=("thigh", "shank"), sensors=(("S1",), ("S2",))
    )
    good = plain_calibration(chain).to_dict()
    folder = process.state / "calibrations" / "default"
    folder.mkdir(parents=True)
    zero = json.loads(json.dumps(good))
    zero["sensor"]["S1"]["q_sensor_segment"] = [0.0, 0.0, 0.0, 0.0]
    for number, content in enumerate((good, {**good, "segment": 3}, zero), 1):
        table = {"sha256": checksum(content), "calibration": content}
        (folder / f"{number:04d}.json").write_text(json.dumps(table))
    process.write(1)
    with running(process) as daemon:
        log = read_log(daemon, ": running, ")
        time.sleep(1)
        assert daemon.poll() is None
        daemon.send_signal(signal.SIGTERM)
        _, rest = daemon.communicate(timeout=PATIENCE_S)
    said = log + rest
    assert daemon.returncode == 0, said
    assert "renamed to 0003.json.bad" in said
    assert "is not a unit quaternion" in said
    assert sorted(path.name for path in folder.iterdir()) == [
        "0001.json", "0002.json.bad", "0003.json.bad",
    ]  # fmt: skip
    monkeypatch.setattr("jointfit_daemon.driver.entry_points", fake_drivers.entry_points)
    (recording,) = (process.state / "recordings").iterdir()
    (configured,) = [e for e in read_events(recording) if isinstance(e, Configured)]
    assert configured.calibration_version == 1


def test_all_files_are_private_with_any_umask(process: Process) -> None:
    process.write(1)
    old = process.state / "calibrations" / "default" / "0001.json"
    old.parent.mkdir(parents=True)
    old.write_text("{}")
    old.chmod(0o644)
    before = os.umask(0)
    try:
        with running(process) as daemon:
            read_log(daemon, ": running, ")
            time.sleep(0.5)
    finally:
        os.umask(before)
    modes = {path: path.stat().st_mode & 0o777 for path in process.state.rglob("*")}
    assert len(modes) >= 5
    assert {mode for path, mode in modes.items() if path.is_file()} == {0o600}
    assert {mode for path, mode in modes.items() if path.is_dir()} == {0o700}
    assert process.state.stat().st_mode & 0o777 == 0o700


def test_under_systemd_lines_have_levels_and_no_time(process: Process) -> None:
    process.write(1)
    with running(process, JOURNAL_STREAM="1:2") as daemon:
        first = read_log(daemon, ": running, ")
        daemon.send_signal(signal.SIGINT)
        _, said = daemon.communicate(timeout=PATIENCE_S)
    assert daemon.returncode == 0
    said = first + said
    assert said.splitlines()
    assert all(line[0] == "<" and line[1].isdigit() for line in said.splitlines()), said


def test_check_prints_a_summary(
    process: Process, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jointfit_daemon.driver.entry_points", fake_drivers.entry_points)
    process.write(1883)
    assert main(["--config", str(process.rig), "--check"]) == 0
    said = capsys.readouterr().out
    assert "bench: valid" in said
    assert "one sensor: no redundancy" in said
    assert "127.0.0.1:1883, topics jointfit/bench/" in said


def test_check_of_a_missing_file_is_a_usage_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--config", str(tmp_path / "none.toml"), "--check"]) == 2
    assert "no such file: check the path" in capsys.readouterr().err


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert __version__ in capsys.readouterr().out


def test_missing_option_config_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([])
    assert ended.value.code == 2
    assert "arguments are required: --config" in capsys.readouterr().err


def test_the_command_line_starts_light() -> None:
    heavy = "scipy", "numpy.random", "typer", "rich", "aiomqtt", "matplotlib"
    code = (
        "import sys, jointfit_daemon.__main__, jointfit_daemon.config;"
        f"print([name for name in {heavy!r} if name in sys.modules])"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"
