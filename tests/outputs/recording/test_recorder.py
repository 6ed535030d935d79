"""The recorder: start, stop, rotation, deletion of old files, and disk failures."""

from __future__ import annotations

import asyncio
import errno
import os
import time
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import Chunk
from jointfit_daemon.outputs.recording import (
    Recorder,
    RecordingLimits,
    RecordingReport,
    _session_writer,
    open_recording,
    read_events,
)
from jointfit_daemon.pipeline.events import (
    ChunkArrived,
    Configured,
    SourceClosed,
    SourceOpened,
    Tick,
    UnixOffset,
)
from tests.outputs.recording.recorded_events import write_recording

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.pipeline.events import Event


def write(recorder: Recorder, events: list[Event]) -> None:
    """Record `events` as one batch."""
    writer = recorder._writer
    assert writer is not None
    for event in events:
        recorder.event(event)
    writer.pause_s = 0.0
    writer.write(recorder._take())
    recorder._pass_reports(writer)


def chunks(first: int, end: int) -> list[Event]:
    return [ChunkArrived("S1", Chunk(number, os.urandom(200))) for number in range(first, end)]


def test_rotated_files_are_one_recording(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, "rig", RecordingLimits(file_bytes=10_000))
    some = [SourceOpened(0, "S1"), *chunks(1, 400)]
    for begin in range(0, 400, 50):
        write(recorder, some[begin : begin + 50])
    recorder.close()
    files = sorted(tmp_path.iterdir())
    assert len(files) >= 4
    assert [path.name[-9:] for path in files[:3]] == ["0001.mcap", "0002.mcap", "0003.mcap"]
    for path in (files[0], files[2], tmp_path):
        recording = open_recording(path)
        assert list(recording.events()) == some
        assert recording.gaps() == []

    files[0].unlink()  # the second file contains the state at its own start
    recording = open_recording(files[1])
    first, *rest = recording.events()
    assert isinstance(first, SourceOpened)
    assert rest == some[-len(rest) :]
    assert not recording.began_with_daemon
    assert recording.gaps() == []

    files[2].unlink()
    (gap,) = open_recording(files[1]).gaps()
    assert gap.reason == "a file of the session is missing"


def test_every_file_begins_with_the_descriptions_of_the_sources(tmp_path: Path) -> None:
    """Frames of cameras have no meaning without the list of marker names before them."""
    described: dict[str, tuple[bytes, ...]] = {}
    limits = RecordingLimits(file_bytes=10_000)
    recorder = Recorder(tmp_path, "rig", limits, autostart=False, describe=lambda: dict(described))
    for event in (SourceOpened(0, "S1"), SourceOpened(0, "mocap")):
        recorder.event(event)
    described["mocap"] = (b"server", b"first list")

    recorder.begin()
    write(recorder, chunks(1, 100))
    described["mocap"] = (b"server", b"second list")
    write(recorder, chunks(100, 200))
    write(recorder, chunks(200, 300))
    recorder.close()
    files = sorted(tmp_path.iterdir())
    assert len(files) >= 3

    def beginning(path: Path) -> list[tuple[str, bytes]]:
        found = [
            event for event in open_recording(path).events() if isinstance(event, ChunkArrived)
        ]
        return [(event.source, event.chunk.data) for event in found[:2]]

    assert beginning(files[0]) == [("mocap", b"server"), ("mocap", b"first list")]
    for path in files[:2]:
        path.unlink()
    assert beginning(files[2]) == [("mocap", b"server"), ("mocap", b"second list")]


def test_the_names_of_a_new_file_and_folder_are_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: set[str] = set()
    fsync = os.fsync

    def sync(fd: int) -> None:
        fsync(fd)
        synced.add(str(Path(f"/proc/self/fd/{fd}").readlink()))

    monkeypatch.setattr(os, "fsync", sync)
    recorder = Recorder(tmp_path / "recordings", "rig")
    write(recorder, chunks(1, 2))
    assert synced == {str(tmp_path), str(tmp_path / "recordings")}
    recorder.close()


def test_files_rotate_by_time(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, "rig", RecordingLimits(file_s=0.0))
    for number in range(3):
        write(recorder, [Tick(number)])
    recorder.close()
    assert len(list(tmp_path.glob("*.mcap"))) >= 3
    assert list(read_events(tmp_path)) == [Tick(0), Tick(1), Tick(2)]


def test_the_oldest_files_of_the_rig_are_deleted_and_reported(tmp_path: Path) -> None:
    (tmp_path / "rig-20200101T000000-0001.mcap").write_bytes(bytes(30_000))
    (tmp_path / "rig-2-20200101T000000-0001.mcap").write_bytes(bytes(30_000))
    (tmp_path / "rig-notes.txt").write_bytes(bytes(30_000))
    reports: list[RecordingReport] = []
    limits = RecordingLimits(file_bytes=10_000, keep_bytes=45_000)
    recorder = Recorder(tmp_path, "rig", limits, reports.append)
    for begin in range(0, 1000, 50):
        write(recorder, chunks(begin, begin + 50))
    recorder.close()
    names = {path.name for path in tmp_path.iterdir()}
    assert {"rig-2-20200101T000000-0001.mcap", "rig-notes.txt"} <= names
    own = [path for path in tmp_path.glob("rig-*-*.mcap") if not path.name.startswith("rig-2-")]
    assert sum(path.stat().st_size for path in own) < 60_000
    assert "rig-20200101T000000-0001.mcap" in reports[0].text
    assert "keep_gb" in reports[0].text


async def test_a_recording_started_later_begins_with_the_state(
    tmp_path: Path, table: dict[str, Any]
) -> None:
    reports: list[RecordingReport] = []
    recorder = Recorder(tmp_path, "rig", report=reports.append, autostart=False)
    configured = Configured(1, parse_rig(table), None)
    for event in (
        configured,
        UnixOffset(2, 5),
        SourceOpened(3, "S1"),
        SourceOpened(3, "S2"),
        SourceClosed(4, "S2", "lost", "unplugged"),
        *chunks(5, 9),
    ):
        recorder.event(event)
    assert not recorder.health().active

    health = await recorder.start()
    again = await recorder.start()
    assert health.file == again.file
    assert recorder.path == tmp_path / f"{health.file}.part"
    recorder.event(Tick(10))
    stopped = await recorder.stop()
    assert (stopped.file, stopped.active, stopped.backlog_bytes) == (health.file, False, 0)
    assert stopped.written_bytes == (tmp_path / health.file).stat().st_size
    assert stopped.duration_s > 0
    assert await recorder.stop() == recorder.health() == stopped
    texts = [report.text for report in reports]
    assert texts[0] == f"recording started: {health.file}"
    assert texts[1].startswith(f"recording stopped: {health.file}, 0.0 MB")
    assert len(texts) == 2

    recording = open_recording(tmp_path / health.file)
    assert not recording.began_with_daemon
    first, unix, opened, *rest = recording.events()
    assert isinstance(first, Configured)
    assert first.rig == configured.rig
    assert isinstance(unix, UnixOffset)
    assert isinstance(opened, SourceOpened)
    assert (unix.offset_ns, opened.source, rest) == (5, "S1", [Tick(10)])
    assert recording.rig_table is not None


async def test_a_start_that_creates_no_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    recorder = Recorder(tmp_path / "file", "rig", autostart=False)
    with pytest.raises(OSError, match=r"file: (Not a directory|File exists)"):
        await recorder.start()
    assert not recorder.health().active


async def test_the_free_space_is_known_before_the_folder_exists(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Path] = []

    def usage(place: Path) -> object:
        asked.append(place)
        return SimpleNamespace(free=93 * 10**9)

    monkeypatch.setattr("shutil.disk_usage", usage)
    recorder = Recorder(tmp_path / "state" / "recordings", "rig", autostart=False)
    assert recorder.health().free_bytes is None
    running = asyncio.create_task(recorder.run())
    await until(lambda: recorder.health().free_bytes == 93 * 10**9)
    running.cancel()
    assert asked == [tmp_path]


class FailingDisk:
    """Disk on which every write beyond a limit fails."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
        self.room_bytes: float = float("inf")
        write, sync = os.write, os.fdatasync

        def write_some(fd: int, data: bytes) -> int:
            if self.room_bytes <= 0:
                raise OSError(number, os.strerror(number))
            count = write(fd, data[: int(min(len(data), self.room_bytes))])
            self.room_bytes -= count
            return count

        monkeypatch.setattr("os.write", write_some)
        monkeypatch.setattr("os.fdatasync", sync)


@pytest.mark.parametrize("room_bytes", [0, 1, 977, 5003])
def test_a_disk_that_is_full_for_a_while_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room_bytes: int
) -> None:
    disk = FailingDisk(monkeypatch, errno.ENOSPC)
    reports: list[RecordingReport] = []
    recorder = Recorder(tmp_path, "rig", report=reports.append)
    some = chunks(0, 200)
    write(recorder, some[:50])
    disk.room_bytes = room_bytes
    write(recorder, some[50:100])
    write(recorder, some[100:150])
    assert "No space left" in str(recorder.health().failure)
    disk.room_bytes = float("inf")
    write(recorder, some[150:])
    recorder.close()
    assert list(read_events(tmp_path)) == some
    assert open_recording(tmp_path).gaps() == []
    assert ["interrupted" in reports[0].text, "resumed, 0" in reports[1].text] == [True, True]


def test_a_disk_that_stays_full_causes_one_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_session_writer, "MOST_UNWRITTEN_BYTES", 10_000)
    disk = FailingDisk(monkeypatch, errno.ENOSPC)
    recorder = Recorder(tmp_path, "rig")
    some = [SourceOpened(0, "S1"), *chunks(1, 600)]
    write(recorder, some[:50])
    disk.room_bytes = 1000
    for begin in range(50, 500, 50):
        write(recorder, some[begin : begin + 50])
    disk.room_bytes = float("inf")
    write(recorder, some[500:])
    health = recorder.health()
    recorder.close()
    (gap,) = open_recording(tmp_path).gaps()
    assert gap.first_sequence + gap.count == 500
    assert "No space left" in gap.reason
    assert (health.failure, health.lost) == (None, gap.count)
    found = list(read_events(tmp_path))
    restored = found.pop(gap.first_sequence)  # the event that restores the state after the gap
    assert isinstance(restored, SourceOpened)
    assert found == some[: gap.first_sequence] + some[500:]


@pytest.mark.parametrize("number", [errno.EFBIG, errno.EIO])
def test_a_file_that_cannot_be_continued_is_followed_by_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setattr(_session_writer, "ABANDON_S", -1.0)
    monkeypatch.setattr(_session_writer, "RETRY_S", 0.0)
    disk = FailingDisk(monkeypatch, number)
    recorder = Recorder(tmp_path, "rig")
    some = [SourceOpened(0, "S1"), *chunks(1, 300)]
    write(recorder, some[:100])
    disk.room_bytes = 3000
    write(recorder, some[100:200])
    disk.room_bytes = float("inf")
    write(recorder, some[200:])
    recorder.close()
    (gap,) = open_recording(tmp_path).gaps()
    assert (gap.first_sequence, gap.count) == (100, 100)
    found = [event for event in read_events(tmp_path) if isinstance(event, ChunkArrived)]
    assert found == some[1:100] + some[200:]


async def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline
        await asyncio.sleep(0.02)


async def test_files_of_earlier_runs_are_repaired_at_the_start(tmp_path: Path) -> None:
    some: list[Event] = [Tick(number) for number in range(100)]
    path = write_recording(tmp_path, some)
    torn = path.with_name("rig-20200101T000000-0001.mcap.part")
    torn.write_bytes(path.read_bytes()[:-300])
    other = torn.with_name("other-20200101T000000-0001.mcap.part")
    other.write_bytes(b"")
    path.unlink()
    reports: list[RecordingReport] = []
    recorder = Recorder(tmp_path, "rig", report=reports.append)
    running = asyncio.create_task(recorder.run(), name="recorder")
    await until(lambda: bool(reports))
    running.cancel()
    await asyncio.wait([running])
    assert "unfinished recording of an earlier run repaired" in reports[0].text
    assert not torn.exists()
    assert other.exists()
    assert list(read_events(torn.with_suffix(""))) == some


async def test_an_unfinished_file_that_a_person_repaired_is_renamed(tmp_path: Path) -> None:
    path = write_recording(tmp_path, [Tick(number) for number in range(100)])
    repaired = path.rename(tmp_path / "rig-20200101T000000-0001.mcap")
    content = repaired.read_bytes()
    unfinished = tmp_path / f"{repaired.name}.part"
    unfinished.write_bytes(content[:-300])
    reports: list[RecordingReport] = []
    recorder = Recorder(tmp_path, "rig", report=reports.append)
    running = asyncio.create_task(recorder.run(), name="recorder")
    await until(lambda: bool(reports))
    running.cancel()
    await asyncio.wait([running])
    assert f"{repaired.name} exists already" in reports[0].text
    assert repaired.read_bytes() == content
    assert (tmp_path / f"{unfinished.name}.bad").read_bytes() == content[:-300]
    assert not unfinished.exists()
