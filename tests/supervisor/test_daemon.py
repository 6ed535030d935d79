"""The daemon in this process: sources, reloads, stops, requests; real or simulated core."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import logging
import os
import signal
import socket
import time
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import orjson
import pytest

from jointfit_daemon.calibration import CalibrationSettings, CalibrationTrial, StaticJob
from jointfit_daemon.config import Rig, parse_rig
from jointfit_daemon.driver import DeviceAbsentError, DeviceLostError
from jointfit_daemon.model import Chain
from jointfit_daemon.outputs.mqtt import MqttClient
from jointfit_daemon.outputs.mqtt._connection import MqttConnection, Outgoing
from jointfit_daemon.outputs.unix_clock import UnixClock
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import (
    ChunkArrived,
    Configured,
    FitJob,
    JobFinished,
    Request,
    SourceClosed,
    SourceOpened,
    Tick,
)
from jointfit_daemon.pipeline.health import (
    ClockHealth,
    CoreHealth,
    DeviceHealth,
    FrameCounts,
    WireCounts,
)
from jointfit_daemon.supervisor._core_runner import LONGEST_TICK_INTERVAL_NS, CoreRunner
from jointfit_daemon.supervisor._fit_runner import FitRunner, _answer
from jointfit_daemon.supervisor._progress_monitor import ProgressMonitor
from jointfit_daemon.supervisor._source_tasks import run_source
from jointfit_daemon.supervisor._systemd_notifier import SystemdNotifier
from jointfit_daemon.supervisor.daemon import Daemon
from tests.broker_fixture import free_port
from tests.lsl_fixture import receive

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from jointfit_daemon.pipeline.events import Event, Output
    from jointfit_daemon.pipeline.stage_observer import StageObserver
    from tests.broker_fixture import Broker
    from tests.fake_drivers import FakeImu


class RecordingCore:
    """Core that stores its input and answers from a script."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.next_deadline_ns: int | None = None
        self.answers: dict[type[Any], list[Output]] = {}
        self.failure: Exception | None = None
        self.stages: StageObserver | None = None

    def feed(self, event: Event) -> list[Output]:
        self.events.append(event)
        if self.failure is not None:
            raise self.failure
        if isinstance(event, Request):
            return [event.reply("accepted", dict(event.arguments))]
        return self.answers.pop(type(event), [])

    def descriptions(self) -> dict[str, tuple[bytes, ...]]:
        return {}

    def health(self, now_ns: int) -> CoreHealth:  # noqa: ARG002 - the core's interface
        return CoreHealth()

    def of(self, kind: type[Any]) -> list[Any]:
        return [event for event in self.events if isinstance(event, kind)]


def small(table: dict[str, Any], port: int, **moods: str) -> dict[str, Any]:
    """Return a rig of two simulated sensors, one on each segment."""
    imus = [imu | {"mood": moods.get(imu["id"], "well")} for imu in table["imu"][:2]]
    imus[1]["segment"] = "shank"
    return {
        "rig": table["rig"],
        "chain": table["chain"],
        "imu": imus,
        "mqtt": {"host": "127.0.0.1", "port": port},
    }


def toml(table: dict[str, Any]) -> str:
    """Return the TOML text of `table`, which contains tables of values and one list of tables."""
    lines = []
    for name, part in table.items():
        for section in part if isinstance(part, list) else [part]:
            lines.append(f"[[{name}]]" if isinstance(part, list) else f"[{name}]")
            lines += [f"{key} = {orjson.dumps(value).decode()}" for key, value in section.items()]
    return "\n".join(lines)


@contextlib.asynccontextmanager
async def daemon(
    table: dict[str, Any], folder: Path, core: Any = None
) -> AsyncIterator[asyncio.Task[None]]:
    path = folder / "rig.toml"
    path.write_text(toml(table), encoding="utf-8")
    task = asyncio.create_task(Daemon(path, parse_rig(table), core or Core()).run(), name="daemon")
    try:
        yield task
    finally:
        began = time.monotonic()
        task.cancel()
        await asyncio.wait([task], timeout=10)
        assert time.monotonic() - began < 5, "stopping took too long"
        asyncio.get_running_loop().set_exception_handler(None)


@pytest.fixture(autouse=True)
def _own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))


async def until(condition: Callable[[], bool], within_s: float = 8.0) -> None:
    async with asyncio.timeout(within_s):
        while not condition():
            await asyncio.sleep(0.01)


# --- one source ---------------------------------------------------------------------------------


class Script:
    """Driver whose runs perform the actions of a list, one after another."""

    steps: list[Any]

    def __init__(self, settings: Any) -> None:
        pass

    async def run(self, emit: Any) -> None:
        step = type(self).steps.pop(0) if type(self).steps else "wait"
        if step == "wait":
            await asyncio.Event().wait()
        if step == "send then go":
            from jointfit_daemon.model import Chunk  # noqa: PLC0415 - here only

            emit(Chunk(1, b"x"))
            raise DeviceLostError("unplugged")
        raise cast("Exception", step)


async def run_script(rig: Rig, steps: list[Any]) -> tuple[list[Event], asyncio.Task[None]]:
    driver = type("Scripted", (Script,), {"steps": steps})
    source = rig.sources[0].__class__("S1", "imu", "x", 100.0, "thigh", None, driver)
    events: list[Event] = []
    task = asyncio.create_task(run_source(source, events.append), name="source")
    await asyncio.wait([task], timeout=1.2)
    task.cancel()
    await asyncio.wait([task])
    return events, task


async def test_lost_device_is_retried_and_reported_once_per_reason(table: dict[str, Any]) -> None:
    gone = DeviceLostError("is not there")
    events, _ = await run_script(
        parse_rig(table), ["send then go", gone, DeviceLostError("is not there"), "send then go"]
    )
    told = [(type(event).__name__, getattr(event, "text", "")) for event in events]
    assert told == [
        ("SourceOpened", ""),
        ("ChunkArrived", ""),
        ("SourceClosed", "unplugged"),
        ("SourceClosed", "is not there"),
        ("SourceOpened", ""),
        ("ChunkArrived", ""),
        ("SourceClosed", "unplugged"),
    ]


async def test_unplugged_device_is_reported_once_until_it_is_back(table: dict[str, Any]) -> None:
    steps = [
        DeviceAbsentError("unplugged"),
        DeviceAbsentError("is not there"),
        DeviceLostError("permission denied"),
        DeviceAbsentError("is not there"),
    ]
    events, _ = await run_script(parse_rig(table), steps)
    told = [getattr(event, "text", "") for event in events]
    assert told == ["unplugged", "permission denied", "is not there"]


async def test_exception_of_a_driver_propagates(table: dict[str, Any]) -> None:
    _, task = await run_script(parse_rig(table), [ZeroDivisionError("bug")])
    assert isinstance(task.exception(), ZeroDivisionError)


# --- the whole shell ----------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "said"), [(1, "1 source"), (2, "2 sources")])
async def test_the_log_counts_the_sources(
    table: dict[str, Any], tmp_path: Path, caplog: pytest.LogCaptureFixture, count: int, said: str
) -> None:
    rig = small(table, free_port())
    rig["chain"] = {"joints": ["hip", "knee", "ankle"][: 1 + count], "segments": ["thigh", "shank"]}
    rig["chain"]["segments"], rig["imu"] = rig["chain"]["segments"][:count], rig["imu"][:count]
    caplog.set_level(logging.INFO)
    async with daemon(rig, tmp_path, RecordingCore()):
        await until(lambda: "running" in caplog.text)
    assert any(record.message.endswith(f"running, {said}") for record in caplog.records)


async def test_misconfigured_device_pauses_and_others_run(
    table: dict[str, Any], tmp_path: Path, fakes: type[FakeImu]
) -> None:
    core = RecordingCore()
    async with daemon(small(table, free_port(), S1="wrong"), tmp_path, core):
        await until(lambda: bool(core.of(SourceClosed)) and len(core.of(ChunkArrived)) > 3)
        (closed,) = core.of(SourceClosed)
        assert (closed.source, closed.reason) == ("S1", "misconfigured")
        assert fakes.running == ["S2"]
    assert fakes.running == []


async def test_a_bug_ends_the_daemon_with_its_exception(
    table: dict[str, Any], tmp_path: Path
) -> None:
    async with daemon(small(table, free_port(), S1="bug"), tmp_path) as task:
        await asyncio.wait([task], timeout=5)
    assert isinstance(task.exception(), ExceptionGroup)
    with pytest.raises(ExceptionGroup) as caught:
        task.result()
    assert caught.value.subgroup(ZeroDivisionError) is not None


async def test_exception_of_the_core_on_a_tick_ends_the_daemon(
    table: dict[str, Any], tmp_path: Path
) -> None:
    core = RecordingCore()
    async with daemon(small(table, free_port(), S1="lost", S2="lost"), tmp_path, core) as task:
        await until(lambda: bool(core.of(Tick)))
        core.failure = ZeroDivisionError("in the core")
        await asyncio.wait([task], timeout=5)
    assert isinstance(task.exception(), ExceptionGroup)


async def test_configuration_is_the_first_event_and_ticks_continue(
    table: dict[str, Any], tmp_path: Path
) -> None:
    core = RecordingCore()
    async with daemon(small(table, free_port(), S1="lost", S2="lost"), tmp_path, core):
        await until(lambda: len(core.of(Tick)) > 3)
    assert isinstance(core.events[0], Configured)
    ticks = [event.t_ns for event in core.of(Tick)]
    assert all(later > earlier for earlier, later in itertools.pairwise(ticks))


async def test_daemon_stops_under_load_in_thirty_of_thirty_attempts(
    table: dict[str, Any], tmp_path: Path, broker: Broker, fakes: type[FakeImu]
) -> None:
    fast = small(table, broker.port)
    for imu in fast["imu"]:
        imu["rate_hz"] = 400
    for number in range(30):
        async with daemon(fast, tmp_path) as task:
            await until(lambda: len(fakes.running) == 2)
            await asyncio.sleep(0.003 * number)
        assert task.cancelled(), f"stop {number}"


async def test_without_a_broker_it_runs_and_stops(
    table: dict[str, Any], tmp_path: Path, fakes: type[FakeImu]
) -> None:
    async with daemon(small(table, free_port()), tmp_path):
        await until(lambda: len(fakes.running) == 2)
        await asyncio.sleep(0.5)


async def test_a_reload_restarts_only_what_changed(
    table: dict[str, Any], tmp_path: Path, broker: Broker, fakes: type[FakeImu]
) -> None:
    rig = small(table, broker.port)
    core = RecordingCore()
    async with daemon(rig, tmp_path, core):
        await until(lambda: len(fakes.running) == 2)
        rig["imu"][1]["rate_hz"] = 50
        (tmp_path / "rig.toml").write_text(toml(rig))
        os.kill(os.getpid(), signal.SIGHUP)
        await until(lambda: fakes.started == ["S1", "S2", "S2"])
        await until(lambda: len(core.of(SourceOpened)) == 3)
    kinds = [
        type(event).__name__
        for event in core.events
        if isinstance(event, Configured | SourceClosed | SourceOpened)
    ]
    assert kinds[:6] == [
        "Configured", "SourceOpened", "SourceOpened",
        "SourceClosed", "Configured", "SourceOpened",
    ]  # fmt: skip


async def test_reload_of_a_faulty_file_changes_nothing(
    table: dict[str, Any], tmp_path: Path, broker: Broker, fakes: type[FakeImu]
) -> None:
    rig = parse_rig(small(table, broker.port))
    core = RecordingCore()
    async with (
        daemon(small(table, broker.port), tmp_path, core),
        MqttClient(rig.mqtt) as client,
    ):
        await client.subscribe("bridge/event")
        await until(lambda: len(fakes.running) == 2)
        (tmp_path / "rig.toml").write_text("[rig]\nnmae = 'x'\n")
        os.kill(os.getpid(), signal.SIGHUP)
        async with asyncio.timeout(5):
            async for topic, event in client.messages():
                if topic == "bridge/event" and event["kind"] == "reload":
                    break
        assert "did you mean 'name'?" in event["text"]
        assert event["level"] == "error"
        assert fakes.started == ["S1", "S2"]
        assert len(core.of(Configured)) == 1


async def test_reload_to_another_base_moves_the_retained_state(
    table: dict[str, Any], tmp_path: Path, broker: Broker, fakes: type[FakeImu]
) -> None:
    rig = small(table, broker.port)
    async with daemon(rig, tmp_path):
        await until(lambda: len(fakes.running) == 2)
        rig["mqtt"]["base"] = "moved/rig"
        (tmp_path / "rig.toml").write_text(toml(rig))
        os.kill(os.getpid(), signal.SIGHUP)
        async with asyncio.timeout(8), MqttClient(parse_rig(rig).mqtt) as client:
            await client.subscribe("bridge/state", "device/+/availability", "calibration")
            found = {}
            async for topic, payload in client.messages():
                found[topic] = payload
                if len(found) == 4 and found["bridge/state"] == {"v": 1, "state": "online"}:
                    break
    assert found["calibration"]["phase"] == "uncalibrated"


async def test_requests_are_answered_once_with_all_faults(
    table: dict[str, Any], tmp_path: Path, broker: Broker
) -> None:
    rig = parse_rig(small(table, broker.port))
    core = RecordingCore()
    async with (
        daemon(small(table, broker.port), tmp_path, core),
        MqttClient(rig.mqtt) as client,
    ):
        await client.subscribe("bridge/state")
        async with asyncio.timeout(5):
            async for _, state in client.messages():
                if state == {"v": 1, "state": "online"}:
                    break
        await asyncio.sleep(0.3)
        good = await client.request("calibrate", {"phase": "static", "seconds": 3.0})
        bad = await client.request("calibrate", {"phse": "x", "seconds": "3"})
        unknown = await client.request("calibrat", {})
    assert (good["status"], good["data"]) == (
        "accepted",
        {"phase": "static", "seconds": 3.0, "force": False},
    )
    assert bad["status"] == "error"
    assert {fault["key"] for fault in bad["error"]["faults"]} == {
        "calibrate.phase", "calibrate.phse", "calibrate.seconds",
    }  # fmt: skip
    assert "did you mean 'calibrate'?" in unknown["error"]["message"]
    assert len(core.of(Request)) == 1


async def test_a_run_of_the_real_core_gives_poses_and_health(
    table: dict[str, Any], tmp_path: Path, broker: Broker
) -> None:
    rig = small(table, broker.port)
    seqs: list[int] = []
    async with daemon(rig, tmp_path), MqttClient(parse_rig(rig).mqtt) as client:
        await client.subscribe("pose", "bridge/health", "device/+/availability")
        health: dict[str, Any] = {}
        async with asyncio.timeout(10):
            async for topic, payload in client.messages():
                if topic == "pose":
                    seqs.append(payload["seq"])
                elif topic == "bridge/health" and payload["latency"]["total_us"]:
                    health = payload
                if len(seqs) > 50 and health:
                    break
    assert seqs == list(range(seqs[0], seqs[0] + len(seqs)))
    assert health["process"]["rss_bytes"] > 1e6
    assert health["link"]["connected"] is True
    assert health["latency"].pop("frames") > 0
    # No frame has a decoding time, because all frames were released at their deadline.
    stages = {name: stage for name, stage in health["latency"].items() if stage is not None}
    assert all(stage["p50"] <= stage["p99"] <= stage["max"] for stage in stages.values())
    assert stages["written_us"]["max"] <= stages["total_us"]["max"]


@pytest.mark.system
async def test_a_receiver_of_lsl_gets_the_frames_of_the_daemon(
    lsl: Any,
    table: dict[str, Any],
    tmp_path: Path,
    broker: Broker,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gc, "freeze", lambda: None)  # frozen objects would keep their sockets open
    rig = small(table, broker.port) | {"lsl": {"name": f"daemon {os.getpid()}"}}

    def pull() -> tuple[list[str], list[float], list[float], float]:
        segments = receive(lsl, f"daemon {os.getpid()} segments")
        rows = [segments.pull_sample(timeout=10.0) for _ in range(50)]
        channels = segments.info(timeout=10.0).get_channel_labels()
        return channels, rows[-1][0], [stamp for _, stamp in rows], lsl.local_clock()

    async with daemon(rig, tmp_path):
        channels, values, stamps, now_s = await asyncio.to_thread(pull)
    assert channels[:4] == ["thigh_qw", "thigh_qx", "thigh_qy", "thigh_qz"]
    assert len(values) == len(channels)
    assert np.diff(stamps) == pytest.approx(0.01, abs=0.005)
    assert 0.0 < now_s - stamps[-1] < 60.0


# --- parts --------------------------------------------------------------------------------------


async def test_a_deadline_in_the_past_causes_a_limited_number_of_ticks() -> None:
    core = RecordingCore()
    core.next_deadline_ns = 0
    runner = CoreRunner(core, UnixClock())
    running = asyncio.create_task(runner.run(), name="core runner")
    await asyncio.sleep(0.1)
    running.cancel()
    await asyncio.wait([running])
    assert 1 < len(core.events) <= 110


async def test_core_receives_a_tick_at_its_deadline() -> None:
    core = RecordingCore()
    runner = CoreRunner(core, UnixClock())
    core.next_deadline_ns = time.monotonic_ns() + LONGEST_TICK_INTERVAL_NS // 2
    running = asyncio.create_task(runner.run(), name="core runner")
    await until(lambda: any(isinstance(event, Tick) for event in core.events))
    tick = next(event for event in core.events if isinstance(event, Tick))
    late_ns = tick.t_ns - core.next_deadline_ns
    running.cancel()
    await asyncio.wait([running])
    assert 0 <= late_ns < 40_000_000


@pytest.fixture
def notified(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield listener


def heard(listener: socket.socket) -> list[str]:
    found = []
    with contextlib.suppress(BlockingIOError):
        while True:
            found.append(listener.recv(4096).decode())
    return found


async def test_systemd_receives_ready_watchdog_status_and_stopping(
    notified: socket.socket,
    monkeypatch: pytest.MonkeyPatch,
    table: dict[str, Any],
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "600000")
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    async with daemon(small(table, free_port(), S1="lost"), tmp_path, RecordingCore()):
        words = []
        for number in range(20):  # the queue of a datagram socket has ten entries
            await asyncio.sleep(0.1)
            words += heard(notified)
            if number == 12:
                os.kill(os.getpid(), signal.SIGHUP)
    words += heard(notified)
    assert words[0].startswith("STATUS=")  # the message contains the known status
    assert words[1] == "READY=1"
    assert words.count("WATCHDOG=1") >= 3
    assert any(word.startswith("STATUS=0 of 2 IMUs, missing S1, S2") for word in words)
    assert any(word.startswith("RELOADING=1\nMONOTONIC_USEC=") for word in words)
    assert words.count("READY=1") == 2
    after = words[words.index("STOPPING=1") + 1 :]
    assert set(after) <= {"WATCHDOG=1"}  # also sent during a slow stop


async def test_unresponsive_systemd_does_not_block_the_loop(
    notified: socket.socket,
) -> None:
    systemd = SystemdNotifier()
    began = time.monotonic()
    for _ in range(15):
        systemd.alive()
    assert time.monotonic() - began < 5
    assert heard(notified)


def test_without_systemd_nothing_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    SystemdNotifier().ready()
    monkeypatch.setenv("NOTIFY_SOCKET", "@nobody-listens-here")
    SystemdNotifier().ready()


def counters(received: int, states: int, late: int = 0) -> CoreHealth:
    """Return the health of a core with one IMU and a camera server."""
    clock = ClockHealth("arrival", 0, None, None, None, None, 0, 0, None, None, None)
    imu, mocap = {"received": received, "late": late}, {"received": 99}
    return CoreHealth(
        {
            "S1": DeviceHealth(True, WireCounts(), None, imu, clock, sensor="ok"),
            "mocap": DeviceHealth(True, WireCounts(), None, mocap, clock),
        },
        frames=FrameCounts(states + 3, 3, 0),
    )


def test_watchdog_trips_only_if_samples_produce_no_state() -> None:
    progress = ProgressMonitor()
    assert progress.has_progressed(counters(0, 0))  # no sample arrives
    assert progress.has_progressed(counters(10, 5))  # states are output
    assert progress.has_progressed(counters(20, 5, late=10))  # the new samples are late
    assert not progress.has_progressed(counters(40, 5, late=10))  # samples in time, but no state
    assert progress.has_progressed(counters(60, 6, late=10))
    assert progress.has_progressed(CoreHealth(frames=FrameCounts(9, 3, 0)))


# --- fits ---------------------------------------------------------------------------------------


def broken_job() -> FitJob:
    """Return a job that fails because it has no trial."""
    chain = Chain(("hip", "knee"), ("thigh",), (("S1",),))
    return FitJob(1, StaticJob(chain, CalibrationSettings(), cast("CalibrationTrial", None)))


async def fit(*, cancel_after_s: float | None = None) -> list[JobFinished]:
    ended: list[Any] = []
    async with asyncio.TaskGroup() as tasks:
        runner = FitRunner(tasks, ended.append)
        runner.start(broken_job())
        if cancel_after_s is not None:
            await asyncio.sleep(cancel_after_s)
            runner.cancel()
    return ended


@pytest.mark.real_time
async def test_failed_fit_reports_its_reason() -> None:
    (ended,) = await fit()
    assert ended.result is None
    assert "AttributeError" in str(ended.error)


async def test_cancelled_fit_is_killed_without_a_result() -> None:
    assert await fit(cancel_after_s=0.05) == []


async def test_progress_of_the_worker_precedes_its_result() -> None:
    lines: list[dict[str, Any]] = []
    pipe = asyncio.StreamReader()
    pipe.feed_data(b'{"progress":0.5,"text":"halfway"}\n{"result":{"quality":{}}}')
    pipe.feed_eof()
    assert await _answer(pipe, lines.append) == {"result": {"quality": {}}}
    assert lines == [{"progress": 0.5, "text": "halfway"}]


async def test_request_on_an_invalid_topic_is_ignored(broker: Broker) -> None:
    from jointfit_daemon.config import MqttSettings  # noqa: PLC0415 - here only

    async with MqttConnection(MqttSettings(host="127.0.0.1", port=broker.port)) as connection:
        await connection.publish(Outgoing("x/bridge/request/calibrate", b"{}", 1))
