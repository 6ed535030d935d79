"""The daemon: one TaskGroup, the core in the middle, events in, outputs out.

Law: cancellation is the only way out. What happens between an event and its outputs is the core's;
this file moves them.

    task             what it does                                      ends
    core time        ticks the core when nothing else does             never
    source ID        runs one driver, retries it                       with the rig
    mqtt             keeps the broker link, hands on requests          with its settings
    ready            tells systemd when every source is known          when it has
    health           tells health, status and the watchdog             never
    recording        writes the event log                              when the disk is full
    fit KIND         one calibration fit in a worker process           with its result
    store            writes one calibration                            when it is on disk
    state check      tries to write to the state directory             when it has
    reload           reads rig.toml again on SIGHUP                    never
"""

from __future__ import annotations

import asyncio
import gc
import logging
import math
import signal
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from jointfit_daemon.config import ConfigError, load_rig
from jointfit_daemon.outputs.log import MqttLogHandler, about
from jointfit_daemon.outputs.mqtt import DisconnectErrorFilter, MqttPublisher, Outbox
from jointfit_daemon.outputs.payloads import TopicWriter
from jointfit_daemon.outputs.recording import EventLogWriter
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import (
    CalibrationReady,
    CalibrationStatus,
    CancelJob,
    Configured,
    DeviceStatus,
    FitJob,
    Notice,
    Reply,
)
from jointfit_daemon.supervisor import _stored_calibrations
from jointfit_daemon.supervisor._calibration_writer import CalibrationWriter
from jointfit_daemon.supervisor._core_runner import CoreRunner
from jointfit_daemon.supervisor._fit_runner import FitRunner
from jointfit_daemon.supervisor._process_statistics import ProcessStatistics
from jointfit_daemon.supervisor._progress_monitor import Progress
from jointfit_daemon.supervisor._source_tasks import SourceTasks, stop
from jointfit_daemon.supervisor._status_line import Pace, Seen, phase_of, status_line
from jointfit_daemon.supervisor._systemd_notifier import SystemdNotifier
from jointfit_daemon.supervisor.process_exit import exit_within
from jointfit_daemon.supervisor.requests import (
    RequestAuthenticator,
    parse_request,
    reply_correlation,
    reply_topic,
)
from jointfit_daemon.supervisor.state_directory import state_directory, write_fault

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from jointfit_daemon.config import Rig
    from jointfit_daemon.outputs.mqtt import Incoming
    from jointfit_daemon.pipeline.events import Output
    from jointfit_daemon.supervisor._core_runner import CoreInterface

log = logging.getLogger(__name__)

LOOK_S = 0.1
"""How often the process looks at itself."""
HEALTH_SOON_S = 0.5
"""Health follows a device that came or went by this much, so that losses show in time."""
KNOWN_S = 2.0
"""A source that was silent for so long after the start counts as absent."""
FAREWELL_S = 0.5
"""How long a stop may wait for the broker to take the last words."""
STOP_S = 4.8
"""Stopping is promised in five seconds, whatever hangs."""
_LEVELS = {"info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}


class Daemon:
    """One rig at work.

    Parameters
    ----------
    config
        rig.toml, read again at every reload.
    rig
        What it said at the start.
    core
        The pure core.
    """

    def __init__(self, config: Path, rig: Rig, core: CoreInterface) -> None:
        self._config, self._rig = config, rig
        self._heart = CoreRunner(core, self._send)
        self._process, self._systemd = ProcessStatistics(), SystemdNotifier()
        self._progress, self._pace = Progress(), Pace()
        self._noise = DisconnectErrorFilter()
        self._asking: Incoming | None = None
        self._online: set[str] = set()
        self._version: int | None = None
        """Of the calibration in force, as logged last."""
        self._state_fault: str | None = None
        self._calibration: CalibrationStatus | None = None
        self._health_due_s = 0.0
        self._hung_up = asyncio.Event()
        self._tasks: asyncio.TaskGroup
        self._sources: SourceTasks
        self._fits: FitRunner
        self._stores: CalibrationWriter
        self._state_check: asyncio.Task[None]
        self._mqtt: asyncio.Task[None]
        self._use_broker(rig)

    def _use_broker(self, rig: Rig) -> None:
        self._outbox = Outbox(f"{rig.mqtt.base}/bridge/state")
        self._link = MqttPublisher(rig.mqtt, self._outbox, self._asked)
        self._reporter = TopicWriter(rig, self._outbox)
        self._take_request_key(rig)

    def _take_request_key(self, rig: Rig) -> None:
        self._guard = RequestAuthenticator(rig.mqtt)
        if self._guard.fault:
            log.error("mqtt: all requests are refused: %s", self._guard.fault)

    async def _move_to_broker(self, before: Rig, rig: Rig) -> None:
        """Leave the old broker in order; the new one gets all that was retained."""
        await stop([self._mqtt])
        known = self._outbox.retained
        self._use_broker(rig)
        for topic, payload in known.items():
            leaf = topic.removeprefix(before.mqtt.base)
            if payload and not leaf.startswith("/bridge/"):
                self._outbox.retain(rig.mqtt.base + leaf, payload)
        self._mqtt = self._tasks.create_task(self._link.run(), name="mqtt")

    # --- life --------------------------------------------------------------------------------

    async def run(self) -> None:
        """Run until cancelled; an exception that is not a cancellation is a bug."""
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._noise)
        loop.add_signal_handler(signal.SIGHUP, self._hung_up.set)
        warnings = MqttLogHandler(self._log_line)
        logging.getLogger().addHandler(warnings)
        try:
            async with asyncio.TaskGroup() as self._tasks:
                await self._start(self._tasks)
                try:
                    await asyncio.Event().wait()
                finally:
                    self._systemd.stopping()
                    self._stores.stop()
                    await self._sources.stop()
                    await self._link.emptied(FAREWELL_S)  # that the devices went, among others
        finally:
            logging.getLogger().removeHandler(warnings)
            loop.remove_signal_handler(signal.SIGHUP)

    async def _start(self, tasks: asyncio.TaskGroup) -> None:
        self._sources = SourceTasks(tasks, self._heart.feed)
        self._fits = FitRunner(tasks, self._heart.feed)
        self._stores = CalibrationWriter(tasks, self._heart.feed, self._tell_not_stored)
        self._open_log(tasks)
        self._state_check = tasks.create_task(self._check_state(), name="state check")
        self._mqtt = tasks.create_task(self._link.run(), name="mqtt")
        self._configure(self._rig)
        tasks.create_task(self._heart.run(), name="core time")
        tasks.create_task(self._look_after(), name="health")
        tasks.create_task(self._reload_when_asked(), name="reload")
        await self._sources.apply(self._rig.sources)
        gc.freeze()  # what a start made stays: going through it all again takes milliseconds
        log.info("%s: running, %d sources", self._rig.name, len(self._rig.sources))
        tasks.create_task(self._ready_when_inputs_are_known(), name="ready")

    async def _ready_when_inputs_are_known(self) -> None:
        await self._sources.known(KNOWN_S)
        self._tell_health()
        self._systemd.ready()

    def _open_log(self, tasks: asyncio.TaskGroup) -> None:
        recording = self._rig.recording
        if recording is None:
            return
        folder = state_directory() / recording.directory
        try:
            self._heart.log = EventLogWriter(folder, self._rig.name)
        except OSError as fault:
            self._tell("recording", f"nothing is recorded: {folder}: {fault.strerror}", "error")
        else:
            log.info("recording events in %s", self._heart.log.path)
            tasks.create_task(self._heart.log.run(), name="recording")

    async def _check_state(self) -> None:
        """Report a state directory that cannot be written before a calibration needs it."""
        folder = state_directory() / "calibrations"
        before, fault = self._state_fault, await asyncio.to_thread(write_fault, folder)
        self._state_fault = fault
        if fault is not None:
            self._tell(
                "state",
                f"state directory cannot be written: {fault}. A calibration will be used and "
                "published, but a restart forgets it: check the mount, rights and free space, or "
                "set STATE_DIRECTORY",
                "error",
            )
        elif before is not None:
            self._tell("state", "state directory can be written again")
        self._stores.retry()

    def _tell_not_stored(self, text: str) -> None:
        self._tell("calibration", text, "error")
        if self._calibration is not None:
            now_ns = time.monotonic_ns()
            self._reporter.handle(replace(self._calibration, t_ns=now_ns, text=text))

    def _log_line(self, level: str, name: str, text: str, suppressed: int) -> None:
        self._reporter.log_line(level, name, text, suppressed)

    def _tell(self, kind: str, text: str, level: str = "info") -> None:
        """Tell what only the shell knows, on the log and on ``bridge/event``."""
        log.log(_LEVELS[level], "%s: %s", kind, text, extra=about(kind, self._rig.name))
        notice = Notice(time.monotonic_ns(), kind, self._rig.name, text)
        self._reporter.event(notice, level)

    # --- outputs of the core -----------------------------------------------------------------

    def _send(self, output: Output) -> None:
        match output:
            case FitJob():
                self._fits.start(output)
            case CancelJob():
                self._fits.cancel()
            case CalibrationReady(calibration):
                self._stores.start(self._rig, calibration)
            case Reply():
                self._answer(output)
            case Notice():
                extra = about(output.kind, output.id)
                log.log(_LEVELS[output.level], "%s: %s", output.id, output.text, extra=extra)
            case CalibrationStatus():
                self._calibration = output
                self._log_calibration(output)
            case DeviceStatus():
                self._came_or_went(output)
        self._reporter.handle(output)

    def _log_calibration(self, status: CalibrationStatus) -> None:
        """Log a change of the calibration, with its file where it was stored or loaded."""
        text, extra = status.text, about("calibration", status.phase)
        if status.version is not None and status.version != self._version:
            path = _stored_calibrations.store_of(self._rig).path(status.version)
            text = f"{text} (version {status.version} in {path})"
        self._version = status.version
        log.log(_LEVELS[status.level], "calibration %s: %s", status.phase, text, extra=extra)

    def _came_or_went(self, status: DeviceStatus) -> None:
        (self._online.add if status.online else self._online.discard)(status.id)
        self._health_due_s = min(self._health_due_s, time.monotonic() + HEALTH_SOON_S)

    # --- requests ----------------------------------------------------------------------------

    def _asked(self, message: Incoming) -> None:
        """Take one request from the broker: answered once, by the core or for it."""
        request = parse_request(message, self._guard)
        if request is None:
            return
        self._asking = message
        try:
            if isinstance(request, Reply):
                self._answer(request)
            else:
                self._heart.feed(request)
                if self._state_check.done():  # one at a time, however many requests come
                    self._state_check = self._tasks.create_task(
                        self._check_state(), name="state check"
                    )
        finally:
            self._asking = None

    def _answer(self, reply: Reply) -> None:
        """Answer where the caller wants it; the core answers while it takes the request."""
        asked = self._asking
        if asked is None:
            self._reporter.reply(reply, None, None)
        else:
            self._reporter.reply(reply, reply_topic(asked), reply_correlation(asked))

    # --- health ------------------------------------------------------------------------------

    async def _look_after(self) -> None:
        loop = asyncio.get_running_loop()
        watchdog_s, fed_s = self._systemd.watchdog_s or math.inf, loop.time()
        self._health_due_s = loop.time() + HEALTH_SOON_S
        while True:
            due = loop.time() + LOOK_S
            await asyncio.sleep(LOOK_S)
            now_s = loop.time()
            self._process.late(now_s - due)
            if now_s - fed_s > watchdog_s / 3 and self._at_work():
                fed_s = now_s
                self._systemd.alive()
            if now_s >= self._health_due_s:
                self._health_due_s = now_s + self._rig.mqtt.health_s
                self._tell_health()

    def _at_work(self) -> bool:
        health = self._heart.core.health(time.monotonic_ns())
        imus = frozenset(source.id for source in self._rig.sources if source.kind == "imu")
        return self._progress.made(health, self._poses(health), imus)

    def _poses(self, health: Mapping[str, object]) -> int:
        """Return how many limb states were made from samples."""
        frames = health.get("frames")
        empty = frames.get("empty", 0) if isinstance(frames, dict) else 0
        return self._heart.states - int(empty)

    def _tell_health(self) -> None:
        health = self._heart.core.health(time.monotonic_ns())
        health["process"] = self._process.figures()
        health["link"] = self._link.figures() | {"noise": self._noise.dropped}
        health["state"] = {"fault": self._state_fault, "not_stored": self._stores.fault}
        if self._heart.log is not None:
            health["recording"] = self._heart.log.figures()
        self._reporter.health(health)
        pace_hz = self._pace.since(self._poses(health), time.monotonic())
        seen = Seen(self._online, phase_of(health), pace_hz, self._link.connected)
        self._systemd.status(status_line(self._rig.sources, seen))

    # --- configuration -----------------------------------------------------------------------

    def _configure(self, rig: Rig) -> None:
        found = self._stores.found(rig)
        for complaint in found.complaints:
            self._tell("calibration", complaint, "warning")
        now_ns = time.monotonic_ns()
        age_s = 0.0 if found.calibration is None else _stored_calibrations.age_of(found.calibration)
        self._heart.feed(Configured(now_ns, rig, found.calibration, found.version, age_s))

    async def _reload_when_asked(self) -> None:
        while True:
            await self._hung_up.wait()
            self._hung_up.clear()
            self._systemd.reloading()
            try:
                rig = await asyncio.to_thread(load_rig, self._config)
            except ConfigError as fault:
                self._tell("reload", f"refused, the running rig stays: {fault}", "error")
            except Exception as error:
                log.exception("reload")
                text = f"refused, the running rig stays: a bug, please report it: {error!r}"
                self._tell("reload", text, "error")
            else:
                await self._change_to(rig)
            self._systemd.ready()

    async def _change_to(self, rig: Rig) -> None:
        """Put `rig` in force; what did not change goes on."""
        before, self._rig = self._rig, rig
        if before.recording != rig.recording:
            self._tell("reload", "[recording] changes at the next start", "warning")
        await self._sources.retire(rig.sources)
        self._reporter.configure(rig)  # clears what is gone, before anything is carried over
        if before.mqtt != rig.mqtt:
            await self._move_to_broker(before, rig)
        else:
            self._take_request_key(rig)  # the file may hold a new one
        self._online &= {source.id for source in rig.sources}
        await self._stores.settle()  # else the store would not have what is in force
        self._configure(rig)
        await self._check_state()
        await self._sources.apply(rig.sources)
        log.info("%s: reloaded, %d sources", rig.name, len(rig.sources))


async def run_daemon(config: Path, rig: Rig, core: Callable[[], CoreInterface] = Core) -> None:
    """Run the daemon until SIGTERM or SIGINT.

    Parameters
    ----------
    config
        rig.toml, read again on SIGHUP.
    rig
        What it says now.
    core
        Makes the core.
    """
    main = asyncio.current_task()
    loop = asyncio.get_running_loop()
    stopping = False

    def stop_once() -> None:
        nonlocal stopping
        if not stopping and main is not None:
            stopping = True
            exit_within(STOP_S, 1, "stopping")
            main.cancel()

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop_once)
    try:
        await Daemon(config, rig, core()).run()
    except asyncio.CancelledError:
        if not stopping:
            raise
        log.info("stopped")
