"""The daemon: one TaskGroup that passes events to the core and its outputs to the sinks.

Invariant: the daemon ends only by cancellation or because of a bug.

    task             purpose                                           end
    core time        feeds ticks to the core                           never
    source ID        runs one driver, with retries                     when the source is removed
    mqtt             publishes the outbox, passes on requests          when [mqtt] changes
    ready            notifies systemd when every source is known       after the notification
    health           publishes health, resets the watchdog             never
    recording        writes the recording, in a thread                 never
    spool            writes and sends messages of an outage            never
    metrics          answers Prometheus, in a thread                   never
    fit KIND         runs one calibration fit in a worker process      with its result
    store            writes one calibration                            when written
    state check      writes a probe to the state directory             when checked
    request NAME     executes one request                              when answered
    reload           loads rig.toml again on SIGHUP                    never
"""

from __future__ import annotations

import asyncio
import gc
import logging
import math
import os
import signal
import time
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from jointfit_daemon.config import ConfigError, Fault, load_rig
from jointfit_daemon.outputs import topics
from jointfit_daemon.outputs.frame_latency import FrameLatency
from jointfit_daemon.outputs.log import MqttLogHandler, journal_fields
from jointfit_daemon.outputs.mqtt import DisconnectErrorFilter, MqttPublisher, Outbox
from jointfit_daemon.outputs.payloads import (
    BridgeHealth,
    StateHealth,
    TopicWriter,
    health_payload,
)
from jointfit_daemon.outputs.recording import DAEMON_HEALTH, DAEMON_NOTICE
from jointfit_daemon.outputs.unix_clock import UnixClock
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import (
    CalibrationReady,
    CalibrationStatus,
    CancelJob,
    Configured,
    DeviceStatus,
    FitJob,
    Notice,
    NoticeKind,
    NoticeLevel,
    Reply,
)
from jointfit_daemon.supervisor import _optional_sinks as sinks
from jointfit_daemon.supervisor._calibration_store import (
    CalibrationWriter,
    calibration_age_s,
    store_directory,
)
from jointfit_daemon.supervisor._core_runner import CoreRunner
from jointfit_daemon.supervisor._fit_runner import FitRunner
from jointfit_daemon.supervisor._notice_log import LEVELS, NoticeLog
from jointfit_daemon.supervisor._overload_monitor import STALL_S, OverloadMonitor
from jointfit_daemon.supervisor._process_statistics import ProcessStatistics
from jointfit_daemon.supervisor._progress_monitor import ProgressMonitor
from jointfit_daemon.supervisor._request_handlers import RequestHandlers
from jointfit_daemon.supervisor._source_tasks import SourceTasks, stop
from jointfit_daemon.supervisor._status_line import FrameRateCounter, status_line
from jointfit_daemon.supervisor._systemd_notifier import SystemdNotifier
from jointfit_daemon.supervisor.process_exit import ExitLimit
from jointfit_daemon.supervisor.requests import (
    RequestAuthenticator,
    RequestDispatcher,
    parse_request,
)
from jointfit_daemon.supervisor.state_directory import (
    WRITE_REMEDY,
    StateDirectoryInUseError,
    lock_again,
    state_directory,
    write_fault,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from jointfit_daemon.config import Rig, Source
    from jointfit_daemon.outputs.mqtt import Incoming
    from jointfit_daemon.outputs.recording import Recorder
    from jointfit_daemon.outputs.sink import Sink
    from jointfit_daemon.pipeline.events import Event, Output
    from jointfit_daemon.supervisor._core_runner import CoreInterface

log = logging.getLogger(__name__)

CHECK_S = 0.1
"""Interval between checks of the event loop's delay and of due health messages, s."""
HEALTH_SOON_S = 0.5
"""Delay of the health message after a device was lost or found, or a notice of the recording, s."""
KNOWN_S = 2.0
"""Longest time that a source without data delays the readiness report to systemd, s."""
FAREWELL_S = 0.5
"""Longest wait until the broker accepts the last messages, s."""
_STORING = ("calibrate", "static", "use-calibration")
"""Names of requests whose results are stored. They cause an immediate check of the state
directory."""
STOP_S = 4.8
"""Longest duration of a stop, s. The documentation promises five seconds."""


class Daemon:
    """One running rig; a `Sink` of the core for jobs, calibrations, replies and device states.

    Parameters
    ----------
    config
        Path of rig.toml, which is read again at every reload.
    rig
        Current content of rig.toml.
    core
        The core, which has no clock and no I/O.
    """

    def __init__(self, config: Path, rig: Rig, core: CoreInterface) -> None:
        self._config, self._rig = config, rig
        self._clock = UnixClock()
        self._latency = core.stages = FrameLatency()
        self._core = CoreRunner(core, self._clock)
        self._core.subscribe(self)
        self._notices = NoticeLog(rig)
        self._core.subscribe(self._notices)
        self._process, self._systemd = ProcessStatistics(), SystemdNotifier()
        self._process_health = self._process.health()
        self._progress, self._frame_rate = ProgressMonitor(), FrameRateCounter()
        self._loop_errors = DisconnectErrorFilter()
        self._overload = OverloadMonitor()
        self._recorder: Recorder | None = None
        self._authenticator: RequestAuthenticator | None = None
        self._state_fault: str | None = None
        # None if the folder was writable at the start, because it is then locked already.
        self._state_lock: int | None = None
        self._calibration: CalibrationStatus | None = None
        self._health_due_s, self._reload_requested = 0.0, asyncio.Event()
        self._changes = asyncio.Lock()
        """Lock that permits one change of the configuration or of a source at a time."""
        self._tasks: asyncio.TaskGroup
        self._sources: SourceTasks
        self._requests: RequestDispatcher
        self._fits: FitRunner
        self._calibrations: CalibrationWriter
        self._state_check: asyncio.Task[None]
        self._mqtt: asyncio.Task[None]
        self._spool = sinks.create_spool(rig, lambda: self._link)
        self._use_broker(rig)

    def _use_broker(self, rig: Rig) -> None:
        self._outbox = Outbox(topics.BRIDGE_STATE.name(rig.mqtt.base))
        self._link = MqttPublisher(rig.mqtt, self._outbox, self._receive_request)
        self._topics = TopicWriter(rig, self._outbox, self._clock, self._spool, self._latency)
        self._core.subscribe(self._topics)
        self._read_request_key(rig)

    def _read_request_key(self, rig: Rig) -> None:
        self._authenticator = RequestAuthenticator(rig.mqtt).continuing(self._authenticator)
        if self._authenticator.fault:
            log.error("mqtt: all requests are refused: %s", self._authenticator.fault)

    async def _move_to_broker(self, before: Rig, rig: Rig) -> None:
        """Disconnect from the old broker, and send the retained messages to the new broker.

        Topics below ``bridge/`` are omitted, because they are published again.
        """
        await self._link.flush(FAREWELL_S)  # includes messages that clear a topic
        await stop([self._mqtt])
        known = self._outbox.retained
        self._core.unsubscribe(self._topics)
        self._use_broker(rig)
        for topic, payload in known.items():
            leaf = topic.removeprefix(before.mqtt.base)
            if payload and leaf != topic and not leaf.startswith("/bridge/"):
                self._outbox.retain(rig.mqtt.base + leaf, payload)
        self._mqtt = self._tasks.create_task(self._link.run(), name="mqtt")

    # --- start and stop ----------------------------------------------------------------------

    async def run(self) -> None:
        """Run until cancelled. Any exception other than a cancellation is a bug."""
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._loop_errors)
        loop.add_signal_handler(signal.SIGHUP, self._reload_requested.set)
        warnings = MqttLogHandler(self._publish_log_line)
        logging.getLogger().addHandler(warnings)
        try:
            async with asyncio.TaskGroup() as self._tasks:
                await self._start(self._tasks)
                try:
                    await asyncio.Event().wait()
                finally:
                    self._systemd.stopping()
                    self._calibrations.stop()
                    await self._sources.stop()
                    await self._link.flush(FAREWELL_S)  # includes "offline" of the devices
        finally:
            logging.getLogger().removeHandler(warnings)
            loop.remove_signal_handler(signal.SIGHUP)
            if self._state_lock is not None:
                os.close(self._state_lock)

    async def _start(self, tasks: asyncio.TaskGroup) -> None:
        self._sources = SourceTasks(tasks, self._core.feed)
        self._fits = FitRunner(tasks, self._core.feed)
        self._calibrations = CalibrationWriter(tasks, self._core.feed, self._report_not_stored)
        handlers = RequestHandlers(self, self._answer_request).table()
        reply = self._publish_reply
        self._requests = RequestDispatcher(tasks, self._core.feed, reply, handlers)
        rig, core, report = self._rig, self._core, self._report
        self._recorder = sinks.create_recorder(rig, core, tasks, report)
        if self._spool is not None:
            tasks.create_task(self._spool.run(), name="spool")
        sinks.start_metrics(rig, self.health, core, tasks, report)
        sinks.start_lsl(rig, core, report)
        self._state_check = tasks.create_task(self._check_state(), name="state check")
        self._mqtt = tasks.create_task(self._link.run(), name="mqtt")

        self._configure(self._rig)
        tasks.create_task(self._core.run(), name="core time")
        tasks.create_task(self._publish_health_regularly(), name="health")
        tasks.create_task(self._reload_on_request(), name="reload")
        await self._sources.apply(self._rig.sources)

        gc.freeze()  # permanent objects are not scanned, because a scan takes milliseconds
        log.info("%s: running, %s", self._rig.name, _count_text(self._rig.sources))
        tasks.create_task(self._notify_when_ready(), name="ready")

    async def _notify_when_ready(self) -> None:
        await self._sources.wait_until_known(KNOWN_S)
        self._publish_health()
        self._systemd.ready()

    async def _check_state(self, *, asked: bool = True) -> None:
        """Report a state directory without write access, before a calibration must be stored.

        `asked` states that the start, a request or a reload caused the check. Otherwise, only
        changes are reported.
        """
        folder = store_directory(self._rig)
        before, fault = self._state_fault, await asyncio.to_thread(write_fault, folder)
        self._state_fault = fault
        if fault is not None and (asked or fault != before):
            self._report(
                NoticeKind.STATE,
                f"state directory cannot be written: {fault}. A calibration will be used and "
                f"published, but lost at a restart: {WRITE_REMEDY}",
                NoticeLevel.ERROR,
            )
        elif fault is None and before is not None:
            self._report(NoticeKind.STATE, "state directory can be written again")
            try:
                self._state_lock = await asyncio.to_thread(lock_again, state_directory())
            except StateDirectoryInUseError as error:
                self._report(NoticeKind.STATE, str(error), NoticeLevel.ERROR)
        self._calibrations.retry()

    def _report_not_stored(self, text: str) -> None:
        self._report(NoticeKind.CALIBRATION, text, NoticeLevel.ERROR)
        if self._calibration is not None:
            now_ns = time.monotonic_ns()
            self._topics.output(replace(self._calibration, t_ns=now_ns, text=text))

    def _publish_log_line(self, level: str, name: str, text: str, suppressed: int) -> None:
        # The topics change with the broker, so they are looked up at each call.
        self._topics.publish_log_line(level, name, text, suppressed)

    def _report(self, kind: NoticeKind, text: str, level: NoticeLevel = NoticeLevel.INFO) -> None:
        """Report a state of the daemon, in the log and on ``bridge/event``."""
        log.log(LEVELS[level], "%s: %s", kind, text, extra=journal_fields(kind, self._rig.name))
        notice = Notice(time.monotonic_ns(), kind, self._rig.name, text, level)
        self._topics.publish_notice(notice)
        if self._recorder is not None:
            self._recorder.daemon_message(DAEMON_NOTICE, notice)
        if kind is NoticeKind.RECORDING:
            self._publish_health_soon()

    # --- outputs of the core -----------------------------------------------------------------

    def event(self, event: Event) -> None:
        """Do nothing, because the daemon does not use the inputs of the core."""

    def output(self, output: Output) -> None:
        """Execute the jobs of the core, and store its calibrations."""
        match output:
            case FitJob():
                self._fits.start(output)
            case CancelJob():
                self._fits.cancel()
            case CalibrationReady(calibration, keep_date):
                self._calibrations.start(self._rig, calibration, keep_date=keep_date)
            case Reply():
                self._requests.note_reply(output)
            case CalibrationStatus():
                self._calibration = output
            case DeviceStatus():
                self._publish_health_soon()

    # --- requests ----------------------------------------------------------------------------

    def _receive_request(self, message: Incoming) -> None:
        """Pass one request to the core or a handler, or publish the reply that refuses it."""
        request = parse_request(message, self._authenticator)
        if request is None:
            return
        if isinstance(request, Reply):
            self._topics.output(request)
            return

        self._requests.receive(request)
        if request.command in _STORING and self._state_check.done():  # one check at a time
            self._state_check = self._tasks.create_task(self._check_state(), name="state check")

    def _publish_reply(self, reply: Reply) -> None:
        self._topics.output(reply)  # topics change with the broker

    def _answer_request(self, reply: Reply) -> None:
        self._publish_reply(reply)
        self._requests.note_reply(reply)

    @property
    def rig(self) -> Rig:
        """The current rig."""
        return self._rig

    def feed(self, event: Event) -> None:
        """Pass one event to the core."""
        self._core.feed(event)

    def subscribe(self, sink: Sink) -> None:
        """Pass all further events and outputs of the core to `sink`."""
        self._core.subscribe(sink)

    def unsubscribe(self, sink: Sink) -> None:
        """End the subscription of `sink`."""
        self._core.unsubscribe(sink)

    async def settle_store(self) -> None:
        """Wait until no calibration is being written."""
        await self._calibrations.settle()

    async def set_output_rate(self, rate_hz: float) -> None:
        """Apply the current configuration with another output rate, until the next reload."""
        async with self._changes:
            await self._change_to(replace(self._rig, output_rate_hz=rate_hz))

    @property
    def recorder(self) -> Recorder:
        """The recorder of the daemon."""
        assert self._recorder is not None  # noqa: S101 - it exists before the first request
        return self._recorder

    async def restart_device(self, name: str) -> None:
        """Close and reopen the port of one device."""
        async with self._changes:
            if name in {source.id for source in self._rig.sources}:  # a reload may have removed it
                await self._sources.restart(name)

    # --- health ------------------------------------------------------------------------------

    async def _publish_health_regularly(self) -> None:
        loop = asyncio.get_running_loop()
        watchdog_s, fed_s = self._systemd.watchdog_s or math.inf, loop.time()
        self._health_due_s = loop.time() + HEALTH_SOON_S
        while True:
            due = loop.time() + CHECK_S
            await asyncio.sleep(CHECK_S)
            now_s = loop.time()
            self._process.add_delay(now_s - due)
            stalled = now_s - due > STALL_S
            if (text := self._overload.stall_warning(now_s - due, now_s)) is not None:
                log.warning("%s", text)
            self._notices.write_due(now_s, stalled=stalled)

            if now_s - fed_s > watchdog_s / 3:
                health = self._core.core.health(time.monotonic_ns())
                if self._progress.has_progressed(health):
                    fed_s = now_s
                    self._systemd.alive()
            if now_s >= self._health_due_s:
                self._health_due_s = now_s + self._rig.mqtt.health_s
                self._publish_health()
                if self._state_fault is not None and self._state_check.done():
                    check = self._check_state(asked=False)
                    self._state_check = self._tasks.create_task(check, name="state check")

    def health(self) -> BridgeHealth:
        """Return the current health.

        Process and latency values are those of the last health message.
        """
        core = self._core.core.health(time.monotonic_ns())
        link = self._link.health(self._loop_errors.dropped)
        state = StateHealth(self._state_fault, self._calibrations.fault)
        recording = None if self._recorder is None else self._recorder.health()
        spool = None if self._spool is None else self._spool.health()
        process, latency = self._process_health, self._latency.health
        return BridgeHealth(core, process, link, state, recording, spool, latency)

    def _publish_health_soon(self) -> None:
        self._health_due_s = min(self._health_due_s, time.monotonic() + HEALTH_SOON_S)

    def _publish_health(self) -> None:
        self._process_health = self._process.health()
        self._latency.end_interval()
        found = self.health()
        self._topics.publish_health(found)
        if self._recorder is not None:
            self._recorder.daemon_message(DAEMON_HEALTH, health_payload(found))

        health, link = found.core, found.link
        if (text := self._overload.drop_warning(link, time.monotonic())) is not None:
            log.warning("%s", text)
        states = health.frames.sent - health.frames.empty
        rate_hz = self._frame_rate.rate_hz(states, time.monotonic())
        rig, online, connected = self._rig.sources, self._notices.online, link.connected
        self._systemd.status(status_line(rig, online, health.phase, rate_hz, connected=connected))

    # --- configuration -----------------------------------------------------------------------

    def _configure(self, rig: Rig) -> None:
        loaded = self._calibrations.load(rig)
        for warning in loaded.warnings:
            self._report(NoticeKind.CALIBRATION, warning, NoticeLevel.WARNING)

        now_ns = time.monotonic_ns()
        age_s = 0.0 if loaded.calibration is None else calibration_age_s(loaded.calibration)
        self._core.feed(Configured(now_ns, rig, loaded.calibration, loaded.version, age_s))

    async def _reload_on_request(self) -> None:
        while True:
            await self._reload_requested.wait()
            self._reload_requested.clear()
            with suppress(ConfigError):  # `reload` has reported the fault
                await self.reload()

    async def reload(self, before_move: Callable[[Rig], None] | None = None) -> Rig | None:
        """Load rig.toml again and apply it.

        Parameters
        ----------
        before_move
            Function that is called with the new rig if its table ``[mqtt]`` has changed. It is
            called before the current connection ends.

        Returns
        -------
        Rig or None
            The new rig; None if `before_move` was called, because the answer is already published.

        Raises
        ------
        ConfigError
            The file is faulty. The running configuration stays in use.
        """
        async with self._changes:
            self._systemd.reloading()
            try:
                rig = await asyncio.to_thread(self._load_rig)
                moves = before_move is not None and rig.mqtt != self._rig.mqtt
                if before_move is not None and moves:
                    before_move(rig)
                    await self._link.flush(FAREWELL_S)
                await self._change_to(rig)
            except ConfigError as fault:
                text = f"refused, the running configuration stays in force: {fault}"
                self._report(NoticeKind.RELOAD, text, NoticeLevel.ERROR)
                raise
            finally:
                self._systemd.ready()
            return None if moves else rig

    def _load_rig(self) -> Rig:
        try:
            return load_rig(self._config)
        except ConfigError:
            raise
        except Exception as error:
            log.exception("reload")
            text = f"cannot be read because of a bug, please report it: {error!r}"
            raise ConfigError(str(self._config), [Fault("rig.toml", text)]) from error

    async def _change_to(self, rig: Rig) -> None:
        """Apply `rig`. Sources and connections that do not change continue to run."""
        before, self._rig = self._rig, rig
        sinks.report_changes(before, rig, self._report)
        await self._sources.retire(rig.sources)

        self._notices.configure(rig)
        self._topics.configure(rig)  # clears topics of removed devices before the move
        if before.mqtt != rig.mqtt:
            await self._move_to_broker(before, rig)
        else:
            self._read_request_key(rig)  # the file may contain a new key

        await self._calibrations.settle()  # otherwise the calibration in force is not in the store
        self._configure(rig)
        await self._check_state()
        await self._sources.apply(rig.sources)
        log.info("%s: reloaded, %s", rig.name, _count_text(rig.sources))


def _count_text(sources: Sequence[Source]) -> str:
    return f"{len(sources)} source{'' if len(sources) == 1 else 's'}"


async def run_daemon(config: Path, rig: Rig, core: Callable[[], CoreInterface] = Core) -> None:
    """Run the daemon until SIGTERM or SIGINT.

    Parameters
    ----------
    config
        Path of rig.toml, which is read again on SIGHUP.
    rig
        Current content of rig.toml.
    core
        Function that creates the core.
    """
    main = asyncio.current_task()
    loop = asyncio.get_running_loop()
    stopping = False
    limit = ExitLimit(STOP_S, 1, "the stop")

    def stop_once() -> None:
        nonlocal stopping
        if not stopping and main is not None:
            stopping = True
            main.cancel()

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop_once)
        # If the event loop hangs, it calls no signal handler. This handler always runs, and the
        # loop still receives the signal through its wake-up descriptor.
        signal.signal(number, lambda *_: limit.start())
    try:
        await Daemon(config, rig, core()).run()
    except asyncio.CancelledError:
        if not stopping:
            raise
        log.info("stopped")
    finally:
        limit.cancel()
