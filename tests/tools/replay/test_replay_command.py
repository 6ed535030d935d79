"""`jointfit replay` prints, verifies and publishes a recording, and names errors of the user."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import socket
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.config import MqttSettings
from jointfit_daemon.outputs.mqtt import BrokerLostError, MqttClient
from jointfit_daemon.pipeline import Core
from jointfit_daemon.reprocessing import Changes
from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.replay import _publication
from jointfit_daemon.tools.replay._player import play_recording
from tests.pipeline.core_feed import BEGIN_NS
from tests.reprocessing.recorded_run import UNIX_NS, RecordedRun, record_run

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from typer.testing import Result

    from tests.broker_fixture import Broker

_LINK_BYTES, _LINK_PAUSE_S = 2048, 0.01
"""Number of bytes that the slow link forwards at once, and the pause after these bytes, s."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    return record_run(tmp_path_factory.mktemp("recording"))


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in arguments])


def test_replay_prints_the_time_line_and_a_summary(run: RecordedRun) -> None:
    ended = invoke("replay", run.path)
    assert ended.exit_code == 0, ended.output
    lines = ended.stdout.splitlines()
    assert "    3.000 s  mark r: first step" in lines
    assert any("calibration static: stand still" in line for line in lines)
    assert lines[-1].startswith(f"r: {run.states} limb states from ")
    assert "as recorded" in lines[-1]


def test_verify_passes_with_exit_code_0(run: RecordedRun) -> None:
    ended = invoke("replay", run.path, "--verify", "--json")
    assert ended.exit_code == 0, ended.output
    found = json.loads(ended.stdout)
    assert found["passed"]
    assert found["compared"]["output/state"] == run.states


def test_verify_fails_with_exit_code_1(run: RecordedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    feed = Core.feed
    monkeypatch.setattr(Core, "feed", lambda core, event: 2 * feed(core, event))
    ended = invoke("replay", run.path, "--verify")
    assert ended.exit_code == 1
    assert "first difference at 0.0" in ended.stdout


def test_stored_version_and_calibration_file_are_used(
    run: RecordedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    store = CalibrationStore(tmp_path / "calibrations", "subject-07")
    version = store.save(run.calibration)
    for given in (version, store.path(version)):
        ended = invoke("replay", run.path, "--calibration", given)
        assert ended.exit_code == 0, ended.output
        assert "processed again" in ended.stdout
        assert "calibration static" not in ended.stdout


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("--speed", "fast"), "--speed fast: expected a number above 0"),
        (("--speed", "-1"), "--speed -1: expected a number above 0"),
        (("--verify", "--mqtt"), "omit --mqtt"),
        (("--base", "x"), "--base: valid with --mqtt only"),
        (("--calibration", "9"), "no such version"),
        (("--calibration", "none.json"), "none.json"),
    ],
)
def test_wrong_options_are_named(
    arguments: tuple[str, ...],
    part: str,
    run: RecordedRun,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    ended = invoke("replay", run.path, *arguments)
    assert ended.exit_code == 2
    assert part in ended.stderr


def test_foreign_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"no recording")
    ended = invoke("replay", path)
    assert ended.exit_code == 2
    assert "x.mcap" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_missing_driver_is_named(run: RecordedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jointfit_daemon.driver.entry_points", lambda **_: ())
    ended = invoke("replay", run.path, "--verify")
    assert ended.exit_code == 2
    assert "xbus" in ended.stderr


@contextlib.asynccontextmanager
async def slow_link(broker: Broker) -> AsyncIterator[str]:
    """Yield the address of a proxy that forwards at most 205 kB/s to the broker."""

    async def forward(
        source: asyncio.StreamReader, sink: asyncio.StreamWriter, pause_s: float
    ) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await source.read(_LINK_BYTES):
                sink.write(data)
                await sink.drain()
                await asyncio.sleep(pause_s)
        sink.close()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        from_broker, to_broker = await asyncio.open_connection(broker.host, broker.port)
        await asyncio.gather(
            forward(reader, to_broker, _LINK_PAUSE_S), forward(from_broker, writer, 0.0)
        )

    listening = socket.create_server(("127.0.0.1", 0))
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _LINK_BYTES)
    async with await asyncio.start_server(serve, sock=listening, limit=_LINK_BYTES):
        yield f"127.0.0.1:{listening.getsockname()[1]}"


@contextlib.asynccontextmanager
async def received_poses(settings: MqttSettings) -> AsyncIterator[list[dict[str, float]]]:
    """Subscribe to the poses of a replay; yield the list of received poses, which grows."""
    poses: list[dict[str, float]] = []
    async with MqttClient(settings) as client:
        await client.subscribe("pose")

        async def listen() -> None:
            async for _, payload in client.messages():
                poses.append(payload)

        listening = asyncio.create_task(listen())
        try:
            yield poses
        finally:
            listening.cancel()


async def wait_for_poses(poses: list[dict[str, float]], number: int) -> None:
    """Return once the broker has delivered this number of poses."""
    async with asyncio.timeout(10):
        while len(poses) < number:
            await asyncio.sleep(0.01)


@pytest.mark.real_time  # the broker drops messages if a subscriber reads too slowly
@pytest.mark.parametrize("speed", [5.0, math.inf])
async def test_replay_over_mqtt_has_its_own_topics_and_recorded_times_and_drops_nothing(
    run: RecordedRun, broker: Broker, speed: float
) -> None:
    settings = MqttSettings(host=broker.host, port=broker.port, base="replay/jointfit/r")
    async with received_poses(settings) as poses:
        address = f"{broker.host}:{broker.port}"
        summary = await play_recording(run.path, Changes(), speed, (None, address), quiet=True)
        await wait_for_poses(poses, summary.states)
    retained = await retained_topics(settings)
    assert summary.took_s >= summary.seconds / speed
    assert (len(poses), summary.dropped) == (summary.states, 0)
    begin_s = (BEGIN_NS + UNIX_NS) / 1e9  # the time stamps are from the recording
    assert all(-1.0 < pose["t_us"] / 1e6 - begin_s < 6.0 for pose in poses)
    assert retained == {}


async def test_replay_ends_after_a_slow_link_took_the_last_messages(
    run: RecordedRun, broker: Broker
) -> None:
    settings = MqttSettings(host=broker.host, port=broker.port, base="replay/jointfit/r")
    async with received_poses(settings) as poses, slow_link(broker) as address:
        summary = await play_recording(run.path, Changes(), math.inf, (None, address), quiet=True)
        assert summary.dropped == 0
        await wait_for_poses(poses, summary.states)
    assert await retained_topics(settings) == {}


async def retained_topics(settings: MqttSettings) -> dict[str, object]:
    """Return the retained messages below a base topic, except the state of the bridge."""
    found: dict[str, object] = {}
    async with MqttClient(settings) as client:
        await client.subscribe("calibration", "bridge/info", "device/+/availability")

        async def listen() -> None:
            async for topic, payload in client.messages():
                found.update({topic: payload})

        listening = asyncio.create_task(listen())
        await asyncio.sleep(0.3)
        listening.cancel()
    return found


async def test_broker_that_does_not_answer_is_named(
    run: RecordedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_publication, "CONNECT_S", 0.3)
    with pytest.raises(BrokerLostError, match=r"broker 127\.0\.0\.1:9: no connection"):
        await play_recording(run.path, Changes(), 5.0, (None, "127.0.0.1:9"), quiet=True)
