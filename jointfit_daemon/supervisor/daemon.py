"""The daemon: one TaskGroup, the core in the middle, events in, outputs out.

Law: cancellation is the only way out. What happens between an event and its outputs is the core's;
this file moves them.

    task             what it does                                      ends
    source ID        runs one driver, retries it                       with the rig
    mqtt             keeps the broker link, answers requests           never
    heartbeat        ticks the core, feeds the watchdog, tells health  never
    fit KIND         one calibration fit in a worker process           with its result
    store            writes one calibration                            when it is on disk
    reload           reads rig.toml again on SIGHUP                    when it is in force
"""

from __future__ import annotations

import asyncio
import dataclasses
import datetime
import logging
import os
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

from jointfit_daemon.calibration.store import CalibrationStore
from jointfit_daemon.config import ConfigError, load_rig
from jointfit_daemon.model import LimbState
from jointfit_daemon.outputs.board import Board
from jointfit_daemon.outputs.event_log import EventLog
from jointfit_daemon.outputs.mqtt import LoopNoise
from jointfit_daemon.outputs.outbox import Outbox
from jointfit_daemon.outputs.publisher import MqttPublisher, command_of
from jointfit_daemon.pipeline.core import Core
from jointfit_daemon.pipeline.events import (
    CalibrationReady,
    CalibrationStored,
    CancelJob,
    Configured,
    FitJob,
    Notice,
    Reply,
    Tick,
)
from jointfit_daemon.supervisor.fits import FitRunner
from jointfit_daemon.supervisor.process import ProcessWatch
from jointfit_daemon.supervisor.requests import parse_request
from jointfit_daemon.supervisor.sources import SourceTasks, stop
from jointfit_daemon.supervisor.systemd import SystemdNotifier

if TYPE_CHECKING:
    from jointfit_daemon.calibration.result import Calibration
    from jointfit_daemon.config import Rig
    from jointfit_daemon.outputs.mqtt import Incoming
    from jointfit_daemon.pipeline.events import Event, Output

log = logging.getLogger(__name__)

HEARTBEAT_S = 0.1
STUCK_S = 3.0
"""Sensors stream and no frame came out for this long: the watchdog is no longer fed."""


def state_directory() -> Path:
    """Return where calibrations are kept: systemd's choice, else ./state."""
    return Path(os.environ.get("STATE_DIRECTORY", "state").split(":")[0])


class Daemon:
    """One rig at work.

    Parameters
    ----------
    config : Path
        rig.toml, read again at every reload.
    rig : Rig
        What it said at the start.
    """

    def __init__(self, config: Path, rig: Rig) -> None:
        self._config, self._rig = config, rig
        self._core = Core()
        self._watch, self._systemd = ProcessWatch(), SystemdNotifier()
        self._outbox = Outbox(f"{rig.mqtt.base}/bridge/state")
        self._link = MqttPublisher(rig.mqtt, self._outbox, self._asked)
        self._board = Board(rig, self._outbox)
        self._noise = LoopNoise()
        self._log: EventLog | None = None
        self._deadline: asyncio.TimerHandle | None = None
        self._deadline_ns: int | None = None
        self._frame_s = time.monotonic()
        self._tasks: asyncio.TaskGroup
        self._sources: SourceTasks
        self._fits: FitRunner

    # --- life --------------------------------------------------------------------------------

    async def run(self) -> None:
        """Run until cancelled; an exception that is not a cancellation is a bug."""
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._noise)
        self._open_log()
        try:
            async with asyncio.TaskGroup() as self._tasks:
                self._sources = SourceTasks(self._tasks, self.deliver)
                self._fits = FitRunner(self._tasks, self.deliver)
                loop.add_signal_handler(signal.SIGHUP, self._hang_up)
                self._mqtt = self._tasks.create_task(self._link.run(), name="mqtt")
                self._configure(self._rig)
                self._tasks.create_task(self._heartbeat(), name="heartbeat")
                await self._sources.apply(self._rig.sources)
                self._systemd.ready()
                log.info("%s: running, %d sources", self._rig.name, len(self._rig.sources))
                await self._until_cancelled()
        finally:
            loop.remove_signal_handler(signal.SIGHUP)
            if self._log is not None:
                self._log.close()

    async def _until_cancelled(self) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            self._systemd.stopping()
            await self._sources.stop()
            self._tell_health()

    def _open_log(self) -> None:
        recording = self._rig.recording
        if recording is None:
            return
        now = datetime.datetime.now(datetime.UTC)
        folder = state_directory() / recording.directory
        path = folder / f"{now:%Y%m%dT%H%M%S.%fZ}.events.jsonl"
        try:
            self._log = EventLog(path)
        except OSError as fault:
            log.error("no recording: %s: %s", path, fault.strerror)  # noqa: TRY400 - not a bug

    # --- events and outputs ------------------------------------------------------------------

    def deliver(self, event: Event) -> None:
        """Feed one event to the core and send what comes out."""
        if self._log is not None:
            self._record(event)
        outputs = self._core.feed(event)
        for output in outputs:
            self._send(output)
        self._arm()

    def _record(self, event: Event) -> None:
        try:
            if self._log is not None:
                self._log.event(event)
        except OSError as fault:  # a full disk ends the recording, not the daemon
            log.error("recording stopped: %s", fault.strerror)  # noqa: TRY400 - not a bug
            self._log = None

    def _send(self, output: Output) -> None:
        if isinstance(output, LimbState):
            self._frame_s = time.monotonic()
            if self._log is not None:
                self._log.state(output)
            self._board.pose(output)
        elif isinstance(output, FitJob):
            self._fits.start(output)
        elif isinstance(output, CancelJob):
            self._fits.cancel()
        elif isinstance(output, CalibrationReady):
            self._tasks.create_task(self._store(output.calibration), name="store")
        else:
            if isinstance(output, Notice):
                level = logging.getLevelName(output.level.upper())
                log.log(level, "%s: %s", output.id, output.text)
            self._board.tell(output)

    def _arm(self) -> None:
        """Set the timer for the core's deadline; the heartbeat covers what is further away."""
        due_ns = self._core.next_deadline_ns
        if due_ns == self._deadline_ns:
            return
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline, self._deadline_ns = None, due_ns
        if due_ns is not None:
            loop = asyncio.get_running_loop()
            self._deadline = loop.call_at(due_ns / 1e9, self._due)

    def _due(self) -> None:
        self._deadline, self._deadline_ns = None, None
        try:
            self.deliver(Tick(time.monotonic_ns()))
        except Exception as bug:  # noqa: BLE001 - in a callback it would only reach a log
            self._fail(bug)

    def _fail(self, bug: BaseException) -> None:
        async def raise_it() -> None:
            raise bug

        self._tasks.create_task(raise_it(), name="bug")

    async def _heartbeat(self) -> None:
        loop = asyncio.get_running_loop()
        told_s = loop.time()
        watchdog_s = self._systemd.watchdog_s
        fed_s = 0.0
        while True:
            due = loop.time() + HEARTBEAT_S
            await asyncio.sleep(HEARTBEAT_S)
            now_s = loop.time()
            self._watch.late(now_s - due)
            self.deliver(Tick(time.monotonic_ns()))
            if watchdog_s is not None and now_s - fed_s > watchdog_s / 3 and not self._stuck():
                fed_s = now_s
                self._systemd.alive()
            if now_s - told_s >= self._rig.mqtt.health_s or self._board.health_wanted(now_s):
                told_s = now_s
                self._tell_health()

    def _stuck(self) -> bool:
        return self._board.online_imus > 0 and time.monotonic() - self._frame_s > STUCK_S

    def _tell_health(self) -> None:
        health = self._core.health(time.monotonic_ns())
        health["process"] = self._watch.figures()
        health["link"] = self._link.figures()
        if self._log is not None:
            health["recording"] = {"bytes": self._log.bytes_written, "file": self._log.path.name}
        self._board.health(health)
        imus = sum(source.kind == "imu" for source in self._rig.sources)
        broker = "broker connected" if self._link.connected else "no broker"
        self._systemd.status(f"{self._board.online_imus} of {imus} IMUs, {broker}")

    # --- configuration and calibration -------------------------------------------------------

    def _configure(self, rig: Rig) -> None:
        stored = CalibrationStore(state_directory(), rig.calibration_store).latest()
        calibration = None if stored is None else stored.calibration
        version = None if stored is None else stored.version
        if stored is not None:
            for note in stored.notes:
                log.warning("calibration: %s", note)
        self.deliver(Configured(time.monotonic_ns(), rig, calibration, version))

    async def _store(self, calibration: Calibration) -> None:
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        dated = dataclasses.replace(calibration, created_utc=now)
        store = CalibrationStore(state_directory(), self._rig.calibration_store)
        try:
            version = await asyncio.to_thread(store.save, dated)
        except OSError as fault:
            text = f"calibration in force but not stored: {fault}"
            log.error("%s", text)  # noqa: TRY400 - a full disk is not a bug
            self._board.tell(Notice(time.monotonic_ns(), "calibration", "store", text, "error"))
            return
        self.deliver(CalibrationStored(time.monotonic_ns(), version))

    def _hang_up(self) -> None:
        self._tasks.create_task(self._reload(), name="reload")

    async def _reload(self) -> None:
        self._systemd.reloading()
        try:
            rig = load_rig(self._config)
        except ConfigError as fault:
            text = f"reload refused, the running configuration stays: {fault}"
            log.error("%s", text)  # noqa: TRY400 - the file's fault
            self._board.tell(Notice(time.monotonic_ns(), "reload", self._rig.name, text, "error"))
        else:
            before, self._rig = self._rig, rig
            if before.mqtt != rig.mqtt:
                await self._move_to_broker(rig)
            self._board.configure(rig)
            self._configure(rig)
            await self._sources.apply(rig.sources)
        self._systemd.ready()

    async def _move_to_broker(self, rig: Rig) -> None:
        """Leave the old broker in order and begin at the new one with everything retained."""
        await stop([self._mqtt])
        self._outbox = Outbox(f"{rig.mqtt.base}/bridge/state")
        self._link = MqttPublisher(rig.mqtt, self._outbox, self._asked)
        self._board = Board(rig, self._outbox)
        self._mqtt = self._tasks.create_task(self._link.run(), name="mqtt")

    # --- requests ----------------------------------------------------------------------------

    def _asked(self, message: Incoming) -> None:
        """Take one request from the broker: answered once, by the core or for it."""
        command = command_of(message)
        request = parse_request(command, message.payload, time.monotonic_ns())
        self._board.asked(message, request.transaction)
        if isinstance(request, Reply):
            self._board.tell(request)
        else:
            self.deliver(request)


async def run_daemon(config: Path, rig: Rig) -> None:
    """Run the daemon until SIGTERM or SIGINT."""
    main = asyncio.current_task()
    loop = asyncio.get_running_loop()
    stopping = False

    def stop() -> None:
        nonlocal stopping
        if not stopping and main is not None:
            stopping = True
            main.cancel()

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop)
    try:
        await Daemon(config, rig).run()
    except asyncio.CancelledError:
        if not stopping:
            raise
        log.info("stopped")
