"""After any sequence of device faults, restarts and reloads, the sources stream again."""

from __future__ import annotations

import asyncio
import selectors
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from typing_extensions import override

from jointfit_daemon.config import Source
from jointfit_daemon.driver import DeviceAbsentError, DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import Chunk
from jointfit_daemon.pipeline.events import ChunkArrived, SourceClosed, SourceOpened
from jointfit_daemon.supervisor._source_tasks import PAUSE_S, SourceTasks

if TYPE_CHECKING:
    from jointfit_daemon.pipeline.events import Event

NAMES = ("S1", "S2", "S3")
MOODS = ("well", "well", "silent", "lost", "absent", "wrong", "ends")


class SimulatedTimeLoop(asyncio.SelectorEventLoop):
    """An event loop whose time advances at once when all tasks wait."""

    def __init__(self) -> None:
        super().__init__(_NeverWaiting(self))
        self.now_s = 1000.0

    @override
    def time(self) -> float:
        """Return the simulated time, s."""
        return self.now_s


class _NeverWaiting(selectors.DefaultSelector):
    """A selector that advances the time of its loop instead of waiting."""

    def __init__(self, loop: SimulatedTimeLoop) -> None:
        super().__init__()
        self._loop = loop

    @override
    def select(self, timeout: float | None = None) -> list[Any]:
        """Return the files that are ready now."""
        self._loop.now_s += timeout or 0.0
        return super().select(0)


class Port:
    """One port: the behaviour of its device, and the number of drivers that have it open."""

    def __init__(self) -> None:
        self.mood, self.opened = "well", 0


class Supervised(RuleBasedStateMachine):
    """The sources of one rig."""

    def __init__(self) -> None:
        super().__init__()
        self.loop = SimulatedTimeLoop()
        self.ports = {name: Port() for name in NAMES}
        self.events: dict[str, list[Event]] = {name: [] for name in NAMES}
        self.drivers: dict[str, Any] = {}
        self.wanted: list[Source] = []
        self.stop = asyncio.Event()
        self.root = self.loop.create_task(self.run())
        self.pass_time(0.0)

    async def run(self) -> None:
        """Run the tasks of all sources until `stop` is set."""
        async with asyncio.TaskGroup() as tasks:
            self.sources = SourceTasks(tasks, self.deliver)
            await self.stop.wait()
            await self.sources.stop()

    def deliver(self, event: Event) -> None:
        """Check the order of the events of one source."""
        assert isinstance(event, SourceOpened | ChunkArrived | SourceClosed)
        before = self.events[event.source]
        is_open = bool(before) and not isinstance(before[-1], SourceClosed)
        assert is_open == isinstance(event, ChunkArrived) or isinstance(event, SourceClosed)
        before.append(event)

    def source(self, name: str, rate_hz: float) -> Source:
        """Return a source on its own port; sources with equal settings are equal."""
        return Source(name, "imu", "test", rate_hz, "thigh", None, self.driver_class(name))

    def driver_class(self, name: str) -> Any:
        """Return the driver class of one port, which is always the same object."""
        port = self.ports[name]

        class Driver:
            def __init__(self, _: Any) -> None:
                self._port = port

            async def run(self, emit: Any) -> None:
                assert self._port.opened == 0, "two drivers have one port open"
                self._port.opened += 1
                try:
                    await self._send(emit)
                finally:
                    try:
                        await asyncio.sleep(0.01)  # a port closes slowly
                    finally:
                        self._port.opened -= 1

            async def _send(self, emit: Any) -> None:
                while True:
                    match self._port.mood:
                        case "well":
                            emit(Chunk(0, b"x"))
                        case "lost":
                            raise DeviceLostError("unplugged")
                        case "absent":
                            raise DeviceAbsentError("no such port")
                        case "wrong":
                            raise DeviceMisconfiguredError("wrong output")
                        case "ends":
                            return
                    await asyncio.sleep(0.1)

        return self.drivers.setdefault(name, Driver)

    def complete(self, work: Any) -> None:
        """Run `work` to its end, and the other tasks meanwhile."""
        self.loop.run_until_complete(work)

    @rule(seconds=st.sampled_from([0.0, 0.05, 0.5, 3.0, 20.0]))
    def pass_time(self, seconds: float) -> None:
        self.complete(asyncio.sleep(seconds))

    @rule(name=st.sampled_from(NAMES), mood=st.sampled_from(MOODS))
    def change_device(self, name: str, mood: str) -> None:
        self.ports[name].mood = mood

    @rule(rates=st.dictionaries(st.sampled_from(NAMES), st.sampled_from([100.0, 200.0])))
    def reload(self, rates: dict[str, float]) -> None:
        self.wanted = [self.source(name, rate_hz) for name, rate_hz in sorted(rates.items())]
        self.complete(self.sources.apply(self.wanted))

    @precondition(lambda self: self.wanted)
    @rule(data=st.data())
    def restart_device(self, data: st.DataObject) -> None:
        self.complete(self.sources.restart(data.draw(st.sampled_from(self.wanted)).id))

    @rule()
    def change_during_a_restart(self) -> None:
        """Lose all devices, and repair the first device 0.1 s later.

        At this time its port is closing, or its source waits for the retry.
        """
        for name in NAMES:
            self.ports[name].mood = "lost"
        self.pass_time(0.1)
        self.change_device(NAMES[0], "well")

    @invariant()
    def the_root_task_runs(self) -> None:
        assert not self.root.done(), self.root

    @invariant()
    def removed_sources_are_closed(self) -> None:
        for name in set(NAMES) - {source.id for source in self.wanted}:
            assert not self.events[name] or isinstance(self.events[name][-1], SourceClosed)
            assert self.ports[name].opened == 0

    @override
    def teardown(self) -> None:
        """Repair all devices: every source streams, a misconfigured one after its pause."""
        for port in self.ports.values():
            port.mood = "well"
        self.pass_time(PAUSE_S + 2.0)
        for source in self.wanted:
            assert isinstance(self.events[source.id][-1], ChunkArrived), source.id
            assert self.ports[source.id].opened == 1
        self.stop.set()
        self.complete(self.root)
        assert all(port.opened == 0 for port in self.ports.values())
        self.loop.close()


@pytest.fixture(autouse=True)
def no_real_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable the waiting for device files, because the ports of these tests have no files."""
    path = "jointfit_daemon.supervisor._source_tasks.device_path"
    monkeypatch.setattr(path, lambda _: None)


def test_no_sequence_of_faults_and_reloads_stops_a_source_for_ever() -> None:
    run_state_machine_as_test(
        Supervised, settings=settings(max_examples=20, stateful_step_count=20)
    )


@pytest.mark.experiment
def test_no_long_sequence_stops_a_source_for_ever() -> None:
    run_state_machine_as_test(
        Supervised, settings=settings(max_examples=60, stateful_step_count=50)
    )
