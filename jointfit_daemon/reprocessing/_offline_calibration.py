"""Calibration from a recording: the recorded phases are repeated, and their fits are recomputed."""

from __future__ import annotations

import datetime
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from jointfit_daemon.outputs.recording import open_recording
from jointfit_daemon.pipeline.events import (
    CalibrationPhase,
    CalibrationReady,
    CalibrationStatus,
    ChunkArrived,
    Configured,
    Request,
    UnixOffset,
)
from jointfit_daemon.reprocessing._errors import ReprocessingError
from jointfit_daemon.reprocessing._processing import Changes, process_events
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.pipeline.events import Event


@dataclass(frozen=True, slots=True)
class OfflineCalibration:
    """Result of the calibration phases of a recording."""

    rig: Rig
    """The configuration at the end of the session."""
    calibration: Calibration | None
    """Last new calibration, with the date of the session; None if no phase yielded a calibration.
    """
    rejected: str | None
    """Reason why the last result was rejected; None if it was accepted."""
    quality: Mapping[str, object]
    """Quality of the last result."""


def calibrate_recording(
    path: Path,
    rig: Rig | None = None,
    report: Callable[[float, CalibrationStatus], None] = lambda _t_s, _status: None,
) -> OfflineCalibration:
    """Repeat the calibration of a recorded session, and return its result.

    Parameters
    ----------
    path
        Path of the recording. For a session in several parts, the path of any part.
    rig
        Rig that replaces the recorded rig, for example with other markers or another method.
    report
        Function that is called with every calibration status. The first argument is the time since
        the beginning of the recording, s.

    Raises
    ------
    ReprocessingError
        The recording contains no calibration phase, or does not fit the rig.
    ConfigError
        The recorded rig cannot be loaded, because a driver is not installed.
    ValueError, OSError
        The file is not a recording, or cannot be read.
    """
    run = _CalibrationRun(report)
    for event, outputs in process_events(
        open_recording(path).events(), Changes(rig, compute_fits=True)
    ):
        run.add_event(event)
        for output in outputs:
            if isinstance(output, CalibrationReady):
                run.add_result(output)
            elif isinstance(output, CalibrationStatus):
                run.add_status(output)

    if run.rig is None:
        raise ReprocessingError(f"{path}: the recording contains no events")
    if run.requests == 0:
        raise ReprocessingError(
            f"{path}: no calibration phase was requested while this session was recorded. Record a "
            "session in which `jointfit calibrate` runs"
        )
    return OfflineCalibration(run.rig, run.calibration, run.rejected, run.quality)


@dataclass(slots=True)
class _CalibrationRun:
    """Collects the results of the calibration phases."""

    report: Callable[[float, CalibrationStatus], None]
    rig: Rig | None = None
    requests: int = 0
    calibration: Calibration | None = None
    rejected: str | None = None
    quality: Mapping[str, object] = field(default_factory=dict)
    begin_ns: int = 0
    now_ns: int = 0
    offset_ns: int | None = None

    def add_event(self, event: Event) -> None:
        """Process an event before its outputs are processed."""
        self.now_ns = event.chunk.t_ns if isinstance(event, ChunkArrived) else event.t_ns
        if isinstance(event, Configured):
            self.begin_ns = event.t_ns if self.rig is None else self.begin_ns
            self.rig = event.rig
        elif isinstance(event, UnixOffset):
            self.offset_ns = event.offset_ns
        elif isinstance(event, Request) and event.command != "mark":
            self.requests += 1

    def add_result(self, ready: CalibrationReady) -> None:
        """Store a new calibration with the date of the session, as the daemon does."""
        self.calibration, self.rejected = ready.calibration, None
        if not ready.keep_date and self.offset_ns is not None:
            unix_s = (self.now_ns + self.offset_ns) / NS_PER_S
            date = datetime.datetime.fromtimestamp(unix_s, datetime.UTC)
            text = date.isoformat(timespec="seconds")
            self.calibration = replace(ready.calibration, created_utc=text)

    def add_status(self, status: CalibrationStatus) -> None:
        """Report a status, and store the quality of a result."""
        self.report((status.t_ns - self.begin_ns) / NS_PER_S, status)
        if status.kept is not None:
            self.rejected, self.quality = status.kept, status.refused
        elif status.phase in (CalibrationPhase.POSED, CalibrationPhase.CALIBRATED):
            self.quality = status.quality
