"""Retries of paused and misconfigured sources, also at a reload."""

from __future__ import annotations

import asyncio
import itertools
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from jointfit_daemon.config import Source, parse_rig
from jointfit_daemon.driver import DeviceMisconfiguredError
from jointfit_daemon.model import Chunk
from jointfit_daemon.pipeline.events import SourceClosed
from jointfit_daemon.supervisor import _source_tasks as sources_module
from jointfit_daemon.supervisor._source_tasks import SourceTasks, run_source
from tests.supervisor.test_source_sequences import SimulatedTimeLoop

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from jointfit_daemon.pipeline.events import Event


class Refused:
    """A driver that has no permission to open its port until `mended` is set."""

    mended = False
    opened = 0

    def __init__(self, settings: Any) -> None:
        pass

    async def run(self, emit: Any) -> None:  # noqa: ARG002 - a driver's interface
        if not type(self).mended:
            raise DeviceMisconfiguredError("no permission: add the user to group dialout")
        type(self).opened += 1
        await asyncio.Event().wait()


async def test_paused_source_is_retried_and_reported_once(
    table: dict[str, Any], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(sources_module, "SERVER_PAUSE_S", 0.05)
    driver: Any = type("Port", (Refused,), {})
    source = parse_rig(table).sources[0].__class__("S1", "imu", "x", 100.0, "thigh", None, driver)
    events: list[Event] = []
    async with asyncio.TaskGroup() as tasks:
        sources = SourceTasks(tasks, events.append)
        await sources.apply([source])
        await asyncio.sleep(0.5)
        driver.mended = True
        async with asyncio.timeout(2):
            while not driver.opened:
                await asyncio.sleep(0.01)
        (closed,) = events
        assert isinstance(closed, SourceClosed)
        assert "add the user to group dialout (retrying" in closed.text
        assert caplog.text == ""  # the core reports the fault, which is then logged
        await sources.stop()


async def test_misconfigured_server_is_retried_sooner_than_a_port(
    table: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sources_module, "PAUSE_S", 60.0)
    monkeypatch.setattr(sources_module, "SERVER_PAUSE_S", 0.05)
    events: list[Event] = []
    drivers: list[Any] = [type("Server", (Refused,), {}), type("Serial", (Refused,), {})]
    ports = (None, SimpleNamespace(port=str(tmp_path)))
    of_rig = type(parse_rig(table).sources[0])
    async with asyncio.TaskGroup() as tasks:
        sources = SourceTasks(tasks, events.append)
        await sources.apply(
            [
                of_rig(name, "imu", "x", 100.0, "thigh", port, driver)
                for name, port, driver in zip(("server", "port"), ports, drivers, strict=True)
            ]
        )
        await asyncio.sleep(0.1)
        for driver in drivers:
            driver.mended = True
        await asyncio.sleep(0.3)
        assert [driver.opened for driver in drivers] == [1, 0]
        texts = {event.source: event.text for event in events if isinstance(event, SourceClosed)}
        assert "(retrying within" in texts["server"]
        assert "when another device is on the port" in texts["port"]
        await sources.stop()


async def test_paused_source_is_retried_at_a_reload(table: dict[str, Any]) -> None:
    driver: Any = type("Port", (Refused,), {})
    source = parse_rig(table).sources[0].__class__("S1", "imu", "x", 100.0, "thigh", None, driver)
    events: list[Event] = []
    async with asyncio.TaskGroup() as tasks:
        sources = SourceTasks(tasks, events.append)
        await sources.apply([source])
        await asyncio.sleep(0.05)
        assert [type(event) for event in events] == [SourceClosed]
        driver.mended = True
        await sources.apply([source])
        await asyncio.sleep(0.05)
        assert driver.opened == 1
        await sources.apply([source])  # a running driver keeps its port
        await asyncio.sleep(0.05)
        assert driver.opened == 1
        await sources.stop()


def test_misconfigured_server_is_retried_once_a_minute_but_soon_after_it_worked() -> None:
    attempts: list[float] = []
    mended = asyncio.Event()

    class Server:
        def __init__(self, _: Any) -> None:
            pass

        async def run(self, emit: Any) -> None:
            attempts.append(asyncio.get_running_loop().time())
            emit(Chunk(0, b"an answer, before the fault is found"))
            if mended.is_set():
                await asyncio.sleep(2.0)
            raise DeviceMisconfiguredError("bitstream newer than known")

    async def run() -> None:
        driver: Any = Server
        source = Source("cameras", "mocap", "x", 100.0, "thigh", None, driver)
        running = asyncio.create_task(run_source(source, lambda _: None))
        await asyncio.sleep(3600.0)
        steps = [after - before for before, after in itertools.pairwise(attempts)]
        assert len(attempts) < 65
        assert all(step < 60.2 for step in steps)
        mended.set()
        await asyncio.sleep(62.5)
        mended.clear()
        await asyncio.sleep(5.2)
        assert attempts[-1] - attempts[-2] < 7.2
        running.cancel()

    with asyncio.Runner(loop_factory=SimulatedTimeLoop) as runner:
        runner.run(run())
