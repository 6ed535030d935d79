"""Writing of calibrations: in sequence, outside the event loop, consistent with a reload."""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import resource
import threading
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.config import Rig, parse_rig
from jointfit_daemon.limb_model import Calibration
from jointfit_daemon.outputs.mqtt import Incoming
from jointfit_daemon.pipeline.events import (
    CalibrationPhase,
    CalibrationReady,
    CalibrationStatus,
    CalibrationStored,
    Configured,
    Request,
)
from jointfit_daemon.pipeline.health import CoreHealth
from jointfit_daemon.supervisor import _calibration_store
from jointfit_daemon.supervisor._calibration_store import CalibrationWriter
from jointfit_daemon.supervisor.daemon import Daemon
from tests.limb_model.plain_calibration import plain_calibration

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from jointfit_daemon.pipeline.events import Event, Output
    from jointfit_daemon.pipeline.stage_observer import StageObserver


@pytest.fixture
def rig(table: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    return parse_rig(table)


def calibration_of(rig: Rig, note: str = "") -> Calibration:
    return plain_calibration(rig.chain, notes=(note,))


class SlowDisk:
    """Disk that writes on command, and counts simultaneous writes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.go = threading.Event()
        self.writing = self.most = 0
        self._save = _calibration_store.save
        monkeypatch.setattr("jointfit_daemon.supervisor._calibration_store.save", self.save)

    def save(self, rig: Rig, calibration: Calibration, **options: Any) -> int:
        self.writing += 1
        self.most = max(self.most, self.writing)
        self.go.wait(5)
        version = self._save(rig, calibration, **options)
        self.writing -= 1
        return version


async def test_two_calibrations_are_written_one_after_the_other(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = SlowDisk(monkeypatch)
    events: list[Event] = []
    complaints: list[str] = []
    async with asyncio.TaskGroup() as tasks:
        runner = CalibrationWriter(tasks, events.append, complaints.append)
        runner.start(rig, calibration_of(rig, "first"))
        runner.start(rig, calibration_of(rig, "second"))
        await asyncio.sleep(0.05)
        disk.go.set()
        await runner.settle()
    assert disk.most == 1
    assert complaints == []
    # The first calibration was no longer active when it was written.
    assert [event.version for event in events if isinstance(event, CalibrationStored)] == [2]
    found = runner.load(rig).calibration
    assert found is not None
    assert found.notes == ("second",)


async def test_unwritten_calibration_stays_in_force_over_a_reload(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **options: Any) -> int:
        raise OSError("no space left")

    _calibration_store.save(rig, calibration_of(rig, "old"))
    monkeypatch.setattr("jointfit_daemon.supervisor._calibration_store.save", full)
    complaints: list[str] = []
    events: list[Event] = []
    async with asyncio.TaskGroup() as tasks:
        runner = CalibrationWriter(tasks, events.append, complaints.append)
        runner.start(rig, calibration_of(rig, "new"))
    assert "no space left" in complaints[0]
    assert events == []
    found = runner.load(rig)
    assert found.calibration == calibration_of(rig, "new")
    assert found.version is None
    assert "not stored" in found.warnings[0]


class ReadyCore:
    """Core that returns a calibration on request, and stores its configuration."""

    next_deadline_ns = None
    stages: StageObserver | None = None

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self.events: list[Event] = []

    def feed(self, event: Event) -> list[Output]:
        self.events.append(event)
        if isinstance(event, Request) and not event.arguments:
            status = CalibrationStatus(event.t_ns, CalibrationPhase.CALIBRATED, "calibrated")
            return [CalibrationReady(self.calibration), status]
        return []

    def descriptions(self) -> dict[str, tuple[bytes, ...]]:
        return {}

    def health(self, now_ns: int) -> CoreHealth:  # noqa: ARG002 - the core's interface
        return CoreHealth()


async def test_a_reload_while_a_calibration_is_written_finds_it(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    disk, core = SlowDisk(monkeypatch), ReadyCore(calibration_of(rig, "new"))
    daemon = Daemon(tmp_path / "rig.toml", rig, core)
    running = asyncio.create_task(daemon.run())
    async with asyncio.timeout(8):
        while not core.events:
            await asyncio.sleep(0.01)
        daemon._core.feed(Request(1, "calibrate", "t", {}))
        reload = asyncio.create_task(daemon._change_to(rig))
        await asyncio.sleep(0.2)
        disk.go.set()
        await reload
    running.cancel()
    await asyncio.wait([running])
    configured = [event for event in core.events if isinstance(event, Configured)]
    assert configured[-1].calibration is not None
    assert configured[-1].calibration_version == 1


async def test_an_unwritable_store_is_reported_at_the_start_like_the_state_directory(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    store = tmp_path / "calibrations" / rig.calibration_store
    store.parent.mkdir()
    store.write_text("")  # a file with the name of the folder
    running = asyncio.create_task(
        Daemon(tmp_path / "rig.toml", rig, ReadyCore(calibration_of(rig, "new"))).run()
    )
    async with asyncio.timeout(20):
        while "state directory cannot be written" not in caplog.text:
            await asyncio.sleep(0.01)
    assert f"{store}: " in caplog.text
    assert "check mount, permissions and free space" in caplog.text
    running.cancel()
    await asyncio.wait([running])


async def test_an_unwritable_state_is_reported_at_the_start_and_the_result_stored_later(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    blocked = tmp_path / "blocked"
    blocked.write_text("")
    monkeypatch.setenv("STATE_DIRECTORY", str(blocked / "state"))
    core = ReadyCore(calibration_of(rig, "new"))
    daemon = Daemon(tmp_path / "rig.toml", rig, core)
    running = asyncio.create_task(daemon.run())
    async with asyncio.timeout(20):
        while "state directory cannot be written" not in caplog.text:
            await asyncio.sleep(0.01)
        assert f"{blocked}/state/calibrations/{rig.calibration_store}: Not a dir" in caplog.text

        daemon._core.feed(Request(1, "calibrate", "t", {}))
        while daemon._calibrations.fault is None:
            await asyncio.sleep(0.01)
        published = daemon._outbox.retained
        assert b"in force but not stored" in published["jointfit/bench-1/calibration"]
        daemon._publish_health()
        assert b'"not_stored":"' in daemon._outbox.retained["jointfit/bench-1/bridge/health"]

        blocked.unlink()
        daemon._receive_request(Incoming("x/calibrate", b'{"phase":"abort"}', retained=False))
        while not any(isinstance(event, CalibrationStored) for event in core.events):
            await asyncio.sleep(0.01)
    assert "can be written again" in caplog.text
    running.cancel()
    await asyncio.wait([running])
    found = _calibration_store.load_latest(rig).calibration
    assert found is not None
    assert found.notes == ("new",)


@contextlib.contextmanager
def full_disk() -> Iterator[None]:
    """Limit files to 1000 bytes; the kernel refuses the rest, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


async def test_a_calibration_on_a_full_disk_is_published_and_stored_when_there_is_space(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("jointfit_daemon.supervisor._calibration_store.RETRY_S", 0.05)
    _calibration_store.save(rig, calibration_of(rig, "old"))
    folder = _calibration_store.store_of(rig).path(1).parent
    core = ReadyCore(calibration_of(rig, "new"))
    daemon = Daemon(tmp_path / "rig.toml", rig, core)
    running = asyncio.create_task(daemon.run())
    async with asyncio.timeout(20):
        while not core.events:
            await asyncio.sleep(0.01)
        with full_disk():
            daemon._core.feed(Request(1, "calibrate", "t", {}))
            while daemon._calibrations.fault is None:
                await asyncio.sleep(0.01)
            await asyncio.sleep(0.2)  # time for some more attempts
            assert "File too large" in daemon._calibrations.fault
            published = daemon._outbox.retained["jointfit/bench-1/calibration"]
            assert b"in force but not stored" in published
            daemon._publish_health()
            health = daemon._outbox.retained["jointfit/bench-1/bridge/health"]
            assert b'"not_stored":"' in health
            assert not (folder / "0002.json").exists()
        while not any(isinstance(event, CalibrationStored) for event in core.events):
            await asyncio.sleep(0.01)
    daemon._publish_health()
    health = daemon._outbox.retained["jointfit/bench-1/bridge/health"]
    assert b'"not_stored":null' in health
    running.cancel()
    await asyncio.wait([running])
    assert sorted(path.name for path in folder.iterdir()) == ["0001.json", "0002.json"]
    found = _calibration_store.load_latest(rig)
    assert (found.version, found.warnings) == (2, ())
    assert found.calibration is not None
    assert found.calibration.notes == ("new",)


async def test_failed_write_is_retried(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jointfit_daemon.supervisor._calibration_store.RETRY_S", 0.05)
    save, failures = _calibration_store.save, ["disk full", "disk full", "gone"]

    def failing(*given: Any, **options: Any) -> int:
        if failures:
            raise OSError(failures.pop(0))
        return save(*given, **options)

    monkeypatch.setattr("jointfit_daemon.supervisor._calibration_store.save", failing)
    events: list[Event] = []
    complaints: list[str] = []
    async with asyncio.TaskGroup() as tasks, asyncio.timeout(5):
        runner = CalibrationWriter(tasks, events.append, complaints.append)
        runner.start(rig, calibration_of(rig, "new"))
        while not events:
            await asyncio.sleep(0.01)
    reasons = [text.split(": ")[2].partition(".")[0] for text in complaints]
    assert reasons == ["disk full", "gone"]
    assert all(text.endswith("; retrying every 0.05 s") for text in complaints)
    found = runner.load(rig)
    assert (found.version, found.warnings) == (1, ())


@pytest.mark.parametrize(
    ("created", "age_s"),
    [
        ("2026-03-01T10:00:00+00:00", 3600.0),
        ("2026-03-01T12:00:00+01:00", 0.0),
        ("2026-03-02T10:00:00+00:00", 0.0),
        ("2026-03-01T10:00:00", 0.0),
        ("", 0.0),
    ],
)
def test_calibration_age_is_zero_if_unknown(created: str, age_s: float) -> None:
    """A date that is missing, has no time zone or is in the future gives the age 0."""
    now = datetime.datetime(2026, 3, 1, 11, tzinfo=datetime.UTC)
    calibration = Calibration("mean", (), (), (), {}, {}, {}, created_utc=created)
    assert _calibration_store.calibration_age_s(calibration, now) == age_s
