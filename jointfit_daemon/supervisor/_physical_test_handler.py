"""The request `physical-test`: a guided test of one sensor during normal operation.

Invariant: a test ends by itself if it is not completed, or if no client requests its state. The
chunks that it stores are therefore limited.
"""

from __future__ import annotations

import asyncio
from dataclasses import asdict
from typing import TYPE_CHECKING, Protocol

from jointfit_daemon.config import Fault
from jointfit_daemon.nearest_name import nearest_name
from jointfit_daemon.physical_test import ROTATIONS, STEPS, PhysicalTest, correction_lines
from jointfit_daemon.pipeline.events import ChunkArrived, SourceClosed
from jointfit_daemon.supervisor.requests import error_of

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig, Source
    from jointfit_daemon.outputs.payloads import BridgeHealth
    from jointfit_daemon.outputs.sink import Sink
    from jointfit_daemon.pipeline.events import Event, Output, Reply, Request

ABANDONED_S = 30.0
"""Time without a request after which a test ends, s. A web page requests the state every second."""
LONGEST_S = 300.0
"""Longest duration of a test, s. The limit also ends a test whose web page remains open."""
OPEN_S = 20.0
"""Longest time from opening to the first orientation, s, including the search for the baud rate."""
RUNNING_PHASES = ("align", "static", "functional", "fitting")
"""Calibration phases that the restart of a device would invalidate."""


class TestedDaemon(Protocol):
    """Operations of the daemon that a test uses."""

    @property
    def rig(self) -> Rig:
        """The current rig."""

    def health(self) -> BridgeHealth:
        """Return the counters and clocks of this instant."""

    def subscribe(self, sink: Sink) -> None:
        """Pass all further events of the core to `sink`."""

    def unsubscribe(self, sink: Sink) -> None:
        """End the subscription of `sink`."""

    async def restart_device(self, name: str) -> None:
        """Close and reopen the port of one device."""


class RunningPhysicalTest:
    """One running test; a `Sink` of the core that receives the chunks of its sensor."""

    def __init__(self, source: Source) -> None:
        self.test = PhysicalTest(source)
        self.failure: str | None = None
        self.result: dict[str, object] | None = None
        self._began_ns: int | None = None

    def event(self, event: Event) -> None:
        """Store the chunks of the sensor; end the test if the sensor is lost."""
        name = self.test.source.id
        if isinstance(event, ChunkArrived) and event.source == name and self.failure is None:
            if self._began_ns is None:
                self._began_ns = event.chunk.t_ns
            if event.chunk.t_ns - self._began_ns > LONGEST_S * 1e9:
                self._end_incomplete()
                return
            had_orientation = self.test.has_orientation
            self.test.add(event.chunk)
            if self.test.has_orientation and not had_orientation:
                self.test.begin()
        elif isinstance(event, SourceClosed) and event.source == name:
            self.failure = self.failure or event.text

    def _end_incomplete(self) -> None:
        """End a test that exceeds its time limit, and delete its chunks."""
        if len(self.test.rests) < len(STEPS):
            self.failure = f"not completed within {LONGEST_S / 60:g} minutes: start the test again"
            self.test = PhysicalTest(self.test.source)

    def output(self, output: Output) -> None:
        """Do nothing, because a test does not use the outputs of the core."""

    async def state(self) -> dict[str, object]:
        """Return the data of an answer. A complete test is evaluated in a thread."""
        test, step = self.test, len(self.test.rests)
        if step == len(STEPS) and self.result is None:
            result = await asyncio.to_thread(test.result)
            self.result = {**asdict(result), "lines": list(correction_lines(result))}
        if self.result is not None:
            return _state(test.source.id, "finished", step, result=self.result)
        if self.failure is not None:
            return _state(test.source.id, "failed", step, text=self.failure)
        return _state(test.source.id, "turning" if test.has_orientation else "opening", step)


def _state(
    name: str,
    state: str,
    step: int = 0,
    *,
    text: str | None = None,
    result: dict[str, object] | None = None,
) -> dict[str, object]:
    return {
        "device": name, "state": state, "step": step,
        "steps": [instruction.format(id=name) for instruction in STEPS],
        "rotations": list(ROTATIONS), "text": text, "result": result,
    }  # fmt: skip


class PhysicalTestHandler:
    """Executes the request `physical-test`. At most one test runs at a time.

    Parameters
    ----------
    daemon
        The daemon whose sensor is tested.
    """

    def __init__(self, daemon: TestedDaemon) -> None:
        self._daemon = daemon
        self._running: RunningPhysicalTest | None = None
        self._end: asyncio.TimerHandle | None = None
        self._too_late: asyncio.TimerHandle | None = None

    async def handle(self, request: Request) -> Reply:
        """Start, continue or stop the test of a sensor."""
        name, action = str(request.arguments["device"]), request.arguments["action"]
        sensors = {each.id: each for each in self._daemon.rig.sources if each.kind == "imu"}
        if name not in sensors:
            expected = f"expected a sensor of rig.toml: {', '.join(sensors)}"
            near = nearest_name(name, sensors)
            return _refusal(request, Fault("physical-test.device", expected, name, near))

        if action == "start":
            if (phase := self._daemon.health().core.phase) in RUNNING_PHASES:
                text = (
                    f"calibration phase {phase} is running and would lose {name}: wait for the end"
                )
                return request.refusal("physical-test.action", text)
            await self._start(sensors[name])
        elif action == "stop":
            self._stop()
            return request.reply("ok", _state(name, "stopped"))

        running = self._running
        if running is None or running.test.source.id != name:
            text = (
                f'no test of {name} is running: send {{"device":"{name}","action":"start"}} first'
            )
            return request.refusal("physical-test.action", text)
        self._extend()
        return request.reply("ok", await running.state())

    async def _start(self, source: Source) -> None:
        """Reopen the sensor, so that the test receives the sensor's replies to the driver."""
        self._stop()
        await self._daemon.restart_device(source.id)
        self._stop()  # another request may have started a test during the restart
        self._running = RunningPhysicalTest(source)
        self._daemon.subscribe(self._running)
        self._too_late = asyncio.get_running_loop().call_later(OPEN_S, self._note_silence)

    def _note_silence(self) -> None:
        running = self._running
        if running is not None and not running.test.has_orientation and running.failure is None:
            running.failure = (
                f"no orientation within {OPEN_S:g} s: the event log and `jointfit doctor` name the "
                "cause"
            )

    def _extend(self) -> None:
        if self._end is not None:
            self._end.cancel()
        self._end = asyncio.get_running_loop().call_later(ABANDONED_S, self._stop)

    def _stop(self) -> None:
        for timer in filter(None, (self._end, self._too_late)):
            timer.cancel()
        running, self._running = self._running, None
        if running is not None:
            self._daemon.unsubscribe(running)


def _refusal(request: Request, fault: Fault) -> Reply:
    return request.reply("error", {}, error_of([fault]))
