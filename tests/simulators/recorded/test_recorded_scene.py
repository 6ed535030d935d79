"""Virtual devices send a recording, and the real drivers receive the recorded measurements."""

from __future__ import annotations

import asyncio
import contextlib
import tomllib
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.config import load_rig
from jointfit_daemon.model import Chunk, ImuSample
from jointfit_simulators.__main__ import USAGE, main
from jointfit_simulators.recorded import (
    RecordedScene,
    RecordedSession,
    UnplayableRecordingError,
    read_session_chunks,
)
from jointfit_simulators.recorded._rig_text import toml_text
from tests.reprocessing.recorded_run import FITTED, rig_table
from tests.reprocessing.recorded_run import record_run as record

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.config import Source

BROKER = ("127.0.0.1", 1883)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> RecordedSession:
    return read_session_chunks(record(tmp_path_factory.mktemp("recording")).path)


def decoded(source: Source, chunks: list[Chunk]) -> list[tuple[float, ...]]:
    """Return the quaternions that the driver's decoder finds, in the convention of the device."""
    decoder = source.driver_class(source.settings).decoder()
    items = [item for chunk in chunks for item in decoder.feed(chunk)]
    return [item.q_native for item in items if isinstance(item, ImuSample)]


async def test_drivers_receive_the_recorded_samples_in_order(
    session: RecordedSession, tmp_path: Path
) -> None:
    reports: list[dict[str, Any]] = []
    scene = RecordedScene(session, tmp_path, BROKER)
    rig = load_rig(tmp_path / "rig.toml")
    received: dict[str, list[Chunk]] = {source.id: [] for source in rig.sources}
    running = [
        asyncio.create_task(source.driver_class(source.settings).run(received[source.id].append))
        for source in rig.sources
    ]
    await scene.run(reports.append)
    await asyncio.sleep(0.2)
    for task in running:
        task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await asyncio.wait(running)

    assert [next(iter(report)) for report in reports] == ["ready", "playing", "sent"]
    for source in rig.sources:
        recorded = decoded(source, [Chunk(t, data) for t, data in session.chunks[source.id]])
        assert len(recorded) > FITTED
        found = decoded(source, received[source.id])
        assert found == recorded[: len(found)]
        assert len(found) >= len(recorded) - 3  # a slow host reads fewer


def test_written_rig_is_the_recorded_one_with_other_ports(
    session: RecordedSession, tmp_path: Path
) -> None:
    async def make() -> None:
        RecordedScene(session, tmp_path, BROKER).close()

    asyncio.run(make())
    written = tomllib.loads((tmp_path / "rig.toml").read_text(encoding="utf-8"))
    assert written["chain"] == rig_table()["chain"]
    assert [imu["id"] for imu in written["imu"]] == ["S1", "S2", "S3", "S4"]
    assert written["imu"][0]["port"] == str(tmp_path / "ttyS1")
    assert written["can"]["can0"]["channel"] == str(tmp_path / "ttycan0")


def test_any_table_is_the_same_after_writing() -> None:
    table = {
        "a": {"b": 1, "c": [1.5, 2.0], "d": {"e": "x\n\"y\"", "f.g": True}},
        "imu": [{"id": "S1", "ids": {"k": 1}}, {"id": "S2"}],
        "can": {"can0": {"channel": "c"}, "can1": {"channel": "d"}},
        "empty": {},
    }  # fmt: skip
    assert tomllib.loads(toml_text(table)) == table


def test_unknown_driver_is_named_with_the_known_ones(
    session: RecordedSession, tmp_path: Path
) -> None:
    rig = {**session.rig, "imu": [{**session.rig["imu"][0], "driver": "acme"}]}
    with pytest.raises(UnplayableRecordingError, match="S1: no simulated device for driver 'acme'"):
        RecordedScene(RecordedSession(rig, session.chunks), tmp_path, BROKER)


@pytest.mark.parametrize("content", [b"", b"no recording", b"\x89MCAP0\r\n" + bytes(40)])
def test_foreign_file_is_named_with_a_remedy(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(UnplayableRecordingError, match=r"x\.mcap: .*complete recording"):
        read_session_chunks(path)


def test_command_reports_a_missing_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["play", "--directory", str(tmp_path), "--recording", str(tmp_path / "none.mcap")]
    assert main(words) == USAGE
    assert "none.mcap" in capsys.readouterr().err


def test_folder_without_a_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(UnplayableRecordingError, match="contains no complete recording"):
        read_session_chunks(tmp_path)
