"""After any sequence of starts, stops, full disks and kills, the recorder can record again."""

from __future__ import annotations

import asyncio
import errno
import os
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test
from typing_extensions import override

from jointfit_daemon.outputs.recording import (
    Recorder,
    RecordingLimits,
    _recorder,
    _session_writer,
    open_recording,
)
from jointfit_daemon.outputs.recording._repair import repair_unfinished
from jointfit_daemon.outputs.recording._session_writer import SessionWriter
from jointfit_daemon.pipeline.events import Tick

if TYPE_CHECKING:
    from collections.abc import Callable

LIMITS = RecordingLimits(file_bytes=20_000)
MOST_WAITING = 40
"""Largest number of events that wait for a slow disk."""


class RecordingMachine(RuleBasedStateMachine):
    """A recorder, its disk, and the events that it received while it was active."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.patch = pytest.MonkeyPatch()
        self.patch.setattr(_recorder, "PENDING_BYTES", MOST_WAITING * 500)
        self.patch.setattr(_session_writer, "MOST_UNWRITTEN_BYTES", 4000)
        self.patch.setattr(_session_writer, "RETRY_S", 0.0)
        self.patch.setattr(_session_writer, "_YIELD_S", 0.0)
        self.patch.setattr(asyncio, "to_thread", at_once)
        self.writers: list[SessionWriter] = []
        self.patch.setattr(_recorder, "SessionWriter", self.new_writer)
        self.write, self.room_bytes = os.write, float("inf")
        self.patch.setattr(os, "write", self.write_to_disk)

        self.loop = asyncio.new_event_loop()
        self.number = self.killed = 0
        self.expected: list[int] = []
        """Numbers of the events that the active recorder received."""
        self.unsafe: list[int] = []
        """Numbers of the events since the last write, which a kill loses."""
        self.recorder = self.new_recorder(autostart=False)

    def new_recorder(self, *, autostart: bool) -> Recorder:
        """Return the recorder of a daemon that starts."""
        return Recorder(self.folder, "rig", LIMITS, autostart=autostart)

    def new_writer(self, *arguments: Any) -> SessionWriter:
        """Return the writer of a session, and store it, because it counts losses."""
        self.writers.append(SessionWriter(*arguments))
        return self.writers[-1]

    def write_to_disk(self, fd: int, data: bytes) -> int:
        """Write as many bytes as the disk has room for."""
        if self.room_bytes <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        count = self.write(fd, data[: int(min(len(data), self.room_bytes))])
        self.room_bytes -= count
        return count

    def complete(self, work: Any) -> Any:
        """Run `work` to its end."""
        return self.loop.run_until_complete(work)

    @rule(room_bytes=st.sampled_from([0.0, 300.0, 5000.0, float("inf"), float("inf")]))
    def change_disk(self, room_bytes: float) -> None:
        self.room_bytes = room_bytes

    @rule(count=st.sampled_from([1, 10, 30, 60]))
    def send(self, count: int) -> None:
        for _ in range(count):
            self.number += 1
            self.recorder.event(Tick(self.number))
            if self.recorder.health().active:
                self.expected.append(self.number)
                self.unsafe.append(self.number)

    @rule()
    def write_regularly(self) -> None:
        self.complete(self.recorder._write())
        if self.recorder.health().failure is None:
            self.unsafe = []

    @rule()
    def start(self) -> None:
        self.check_start(self.complete(outcome(self.recorder.start())))

    def check_start(self, found: object) -> None:
        """Check that a start was refused because of the disk, or that the recorder records."""
        if isinstance(found, OSError):
            assert self.room_bytes < float("inf"), "refused although the disk has room"
            assert not self.recorder.health().active
        else:
            assert self.recorder.health().active
            if self.room_bytes == float("inf"):
                self.write_regularly()
                assert self.recorder.health().file

    @rule()
    def stop(self) -> None:
        writer = self.recorder._writer
        health = self.complete(self.recorder.stop())
        assert not health.active
        assert health == self.recorder.health()
        if writer is not None:
            assert health.lost == writer.lost
        self.unsafe = []

    @rule()
    def stop_on_a_full_disk(self) -> None:
        self.send(30)
        self.change_disk(0.0)
        self.stop()

    @rule(order=st.permutations(["start", "stop", "start", "_write"]))
    def storm(self, order: list[str]) -> None:
        """Send simultaneous requests; no answer names a recording that does not run."""

        async def all_at_once() -> list[Any]:
            calls = (getattr(self.recorder, name) for name in order)
            return await asyncio.gather(*(outcome(call()) for call in calls))

        answers = dict(zip(order, self.complete(all_at_once()), strict=True))
        if order.index("stop") < order.index("start"):  # both starts follow the stop
            started = not isinstance(answers["start"], OSError)
            assert self.recorder.health().active == started
        self.unsafe = []

    @rule(autostart=st.booleans())
    def kill_daemon(self, autostart: bool) -> None:
        """Kill the daemon: unwritten events are lost, and the next start repairs the file."""
        self.killed += len(self.unsafe)
        writer = self.recorder._writer
        if writer is not None and writer._part is not None:
            writer._part.close()
        self.begin_again(autostart=autostart)

    @rule(autostart=st.booleans())
    def stop_daemon(self, autostart: bool) -> None:
        self.recorder.close()
        self.begin_again(autostart=autostart)

    def begin_again(self, *, autostart: bool) -> None:
        """Start the daemon again, with a disk that has room for the repair."""
        room_bytes, self.room_bytes = self.room_bytes, float("inf")
        repair_unfinished(self.folder, "rig", lambda: False)
        self.room_bytes = room_bytes
        self.recorder, self.unsafe = self.new_recorder(autostart=autostart), []

    @invariant()
    def the_state_can_be_read(self) -> None:
        health = self.recorder.health()
        assert health.backlog_bytes <= MOST_WAITING * 500 + 500 + 4000 + 40_000

    @override
    def teardown(self) -> None:
        """Stop and start the recorder; the number of missing events must be known."""
        try:
            self.room_bytes = float("inf")
            self.stop()
            self.start()
            self.send(3)
            self.stop()
            self.begin_again(autostart=False)
            recorded = [
                event.t_ns
                for path in sorted(self.folder.glob("*.mcap"))
                for event in open_recording(path).events()
                if isinstance(event, Tick)
            ]
            assert recorded[-3:] == [self.number - 2, self.number - 1, self.number]
            assert recorded == sorted(set(recorded)), "recorded twice or in another order"
            assert set(recorded) <= set(self.expected)
            lost = sum(writer.lost for writer in self.writers) + self.killed
            assert len(self.expected) - len(recorded) <= lost, "lost, but not counted"
        finally:
            self.patch.undo()
            self.loop.close()
            shutil.rmtree(self.folder)


async def outcome(work: Any) -> Any:
    """Return the result of `work`, or the error of the disk."""
    try:
        return await work
    except OSError as error:
        return error


async def at_once(work: Callable[..., Any], *arguments: Any) -> Any:
    """Run `work` after other tasks, in this thread."""
    await asyncio.sleep(0)
    return work(*arguments)


def test_no_sequence_of_requests_and_faults_stops_the_recorder_for_ever() -> None:
    run_state_machine_as_test(
        RecordingMachine, settings=settings(max_examples=15, stateful_step_count=20)
    )


@pytest.mark.experiment
def test_no_long_sequence_stops_the_recorder_for_ever() -> None:
    run_state_machine_as_test(
        RecordingMachine, settings=settings(max_examples=60, stateful_step_count=40)
    )
