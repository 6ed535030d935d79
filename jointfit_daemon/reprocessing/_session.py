"""Conversion of a recording to arrays, with the recorded configuration or another one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.calibration.record import MOST_BYTES, calibration_of
from jointfit_daemon.config import DEFAULT_STORE
from jointfit_daemon.files.text import parse_json, read_bounded
from jointfit_daemon.outputs.recording import PROGRAM, RecordingGap, open_recording, read_events
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import (
    CalibrationPhase,
    CalibrationStatus,
    ChunkArrived,
    Configured,
)
from jointfit_daemon.reprocessing._errors import ReprocessingError
from jointfit_daemon.reprocessing._processing import Changes, process_events
from jointfit_daemon.reprocessing._session_collector import SessionCollector

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.outputs.recording import Recording
    from jointfit_daemon.pipeline.events import Event
    from jointfit_daemon.session_data import SessionData


def load_session(
    path: Path, rig: Rig | None = None, calibration: Calibration | None = None
) -> SessionData:
    """Process a recording in a new core, and return its measurements and results.

    Parameters
    ----------
    path
        Path of the recording. For a session in several parts, the path of any part.
    rig
        Rig that replaces the recorded rig. With another rig, calibrations are fitted again.
    calibration
        Calibration to use from the first to the last event, instead of the recorded calibrations.

    Raises
    ------
    ReprocessingError
        The rig or the calibration does not fit the recording, or the recording is empty.
    ConfigError
        The recorded rig cannot be loaded, because a driver is not installed.
    ValueError
        The file is not a recording.
    OSError
        The file cannot be read.
    """
    collector = SessionCollector()
    core = Core(collector.add_measurement)
    last_rig: Rig | None = None
    in_force, now_ns = "none", 0
    changes = Changes(rig, calibration)
    recording = open_recording(path)
    events = _note_gaps(recording, collector)
    for event, outputs in process_events(events, changes, core):
        collector.add_event(event, outputs)
        if not isinstance(event, ChunkArrived):
            now_ns = event.t_ns
        if isinstance(event, Configured):
            last_rig = event.rig
        for output in outputs:
            if isinstance(output, CalibrationStatus):
                in_force = "none"
                if output.phase in (CalibrationPhase.CALIBRATED, CalibrationPhase.POSED):
                    version = output.version
                    in_force = "not stored" if version is None else f"version {version}"
    if last_rig is None:
        raise ReprocessingError(f"{path}: the recording contains no events")

    collector.add_health(now_ns, last_rig, core.health(now_ns))
    chain = last_rig.chain
    description = {
        "rig": last_rig.name,
        "recording": path.name,
        "limb": ", ".join(chain.segments),
        "side": "both" if chain.parents else "left" if chain.left_side else "right",
        "calibration": in_force,
        "software": recording.info.program,
        "source": "processed again" if changes.any else "as recorded",
    }
    if last_rig.calibration_store != DEFAULT_STORE:
        description["subject"] = last_rig.calibration_store
    if recording.info.program != PROGRAM:
        description["processed"] = PROGRAM
    return collector.session(last_rig, core.lags_ns, description)


def _note_gaps(recording: Recording, collector: SessionCollector) -> Iterator[Event]:
    """Yield the events of a recording, and pass its gaps to the collector."""
    for item in recording.messages():
        if isinstance(item, RecordingGap):
            collector.add_gap(item)
        elif (event := item.event()) is not None:
            yield event


def recorded_rig(path: Path) -> Rig:
    """Return the first rig of a recording.

    Raises
    ------
    ReprocessingError
        The recording contains no configuration.
    ConfigError
        The recorded rig cannot be loaded, because a driver is not installed.
    ValueError, OSError
        The file is not a recording, or cannot be read.
    """
    for event in read_events(path):
        if isinstance(event, Configured):
            return event.rig
    raise ReprocessingError(f"{path}: the recording contains no configuration")


def load_calibration(path: Path) -> Calibration:
    """Return the calibration of a file: a stored version, or the output of `jointfit fuse fit`.

    Raises
    ------
    ReprocessingError
        The content is not a usable calibration.
    OSError
        The file cannot be read.
    """
    try:
        return calibration_of(parse_json(read_bounded(path, MOST_BYTES).decode("utf-8-sig")))
    except (ValueError, RecursionError) as error:
        raise ReprocessingError(
            f"{path}: cannot be used as a calibration ({str(error) or type(error).__name__:.300}): "
            "choose a file of a calibration store"
        ) from error
