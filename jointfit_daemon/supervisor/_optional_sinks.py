"""Sinks that rig.toml or a request enables: recording, metrics, Lab Streaming Layer (LSL).

A sink receives the input events and the outputs of the core (`outputs.sink`).

Invariant: a sink that cannot start is reported, and the daemon runs without it.
"""

from __future__ import annotations

import logging
import math
from operator import attrgetter
from typing import TYPE_CHECKING, Protocol

from jointfit_daemon.config import RecordingSettings
from jointfit_daemon.outputs.recording import Recorder, RecordingLimits, RecordingReport
from jointfit_daemon.outputs.spool import Spool, SpoolFiles
from jointfit_daemon.pipeline.events import NoticeKind, NoticeLevel
from jointfit_daemon.supervisor.state_directory import state_directory

if TYPE_CHECKING:
    from asyncio import TaskGroup
    from collections.abc import Callable

    from jointfit_daemon.config import Rig
    from jointfit_daemon.outputs.mqtt import MqttPublisher
    from jointfit_daemon.outputs.payloads import BridgeHealth
    from jointfit_daemon.supervisor._core_runner import CoreRunner

log = logging.getLogger(__name__)


class Report(Protocol):
    """Interface of the function that reports a state of the daemon."""

    def __call__(self, kind: NoticeKind, text: str, level: NoticeLevel) -> None:
        """Publish and log the state."""


def create_recorder(rig: Rig, core: CoreRunner, tasks: TaskGroup, report: Report) -> Recorder:
    """Return the recorder. It starts recording at once if rig.toml requests this."""
    settings = rig.recording or RecordingSettings(autostart=False)
    folder = state_directory() / settings.directory
    limits = RecordingLimits(
        file_bytes=settings.file_mb * 1e6,
        file_s=settings.file_minutes * 60.0,
        keep_bytes=math.inf if settings.keep_gb is None else settings.keep_gb * 1e9,
    )

    def pass_report(found: RecordingReport) -> None:
        report(NoticeKind.RECORDING, found.text, found.level)

    recorder = Recorder(
        folder,
        rig.name,
        limits,
        pass_report,
        autostart=settings.autostart,
        describe=core.core.descriptions,
    )
    if settings.autostart:
        log.info("recording in %s", folder)
    core.subscribe(recorder)
    tasks.create_task(recorder.run(), name="recording")
    return recorder


def create_spool(rig: Rig, link: Callable[[], MqttPublisher]) -> Spool | None:
    """Return the spool of `rig` if rig.toml has the table ``[mqtt.spool]``; None otherwise."""
    settings = rig.mqtt.spool
    if settings is None:
        return None
    folder = state_directory() / "spool" / rig.name
    return Spool(SpoolFiles(folder, round(settings.keep_mb * 1e6)), link)


def report_changes(before: Rig, rig: Rig, report: Report) -> None:
    """Report changed settings of sinks that take effect only after a restart of the daemon."""
    for key in ("recording", "metrics", "lsl", "mqtt.spool"):
        if attrgetter(key)(before) != attrgetter(key)(rig):
            text = f"a change of [{key}] requires a restart"
            report(NoticeKind.RELOAD, text, NoticeLevel.WARNING)


def start_metrics(
    rig: Rig,
    health: Callable[[], BridgeHealth],
    core: CoreRunner,
    tasks: TaskGroup,
    report: Report,
) -> None:
    """Start the server of the metrics if rig.toml configures its address."""
    if rig.metrics is None:
        return
    from jointfit_daemon.outputs.metrics import (  # noqa: PLC0415 - modules of an HTTP server
        FrameStatistics,
        MetricsError,
        MetricsServer,
    )

    frames = FrameStatistics()
    server = MetricsServer(rig.metrics, rig.name, health, frames)
    try:
        server.start()
    except MetricsError as fault:
        report(NoticeKind.METRICS, f"metrics are off: {fault}", NoticeLevel.ERROR)
    else:
        log.info("metrics at %s", server.url)
        core.subscribe(frames)
        tasks.create_task(server.run(), name="metrics")


def start_lsl(rig: Rig, core: CoreRunner, report: Report) -> None:
    """Create the streams of the Lab Streaming Layer if rig.toml has the table ``[lsl]``."""
    if rig.lsl is None:
        return
    from jointfit_daemon.outputs.lsl import LslError, LslOutlet  # noqa: PLC0415 - rarely used

    outlet = LslOutlet(rig.lsl, rig.name, rig.output_rate_hz)
    try:
        outlet.start()
    except LslError as fault:
        report(NoticeKind.LSL, f"LSL is off: {fault}", NoticeLevel.ERROR)
    else:
        log.info("streams of LSL: %s segments, %s joints", *[rig.lsl.name or rig.name] * 2)
        core.subscribe(outlet)
