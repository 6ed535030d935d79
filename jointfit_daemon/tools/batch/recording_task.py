"""Processing of one recording of a batch, in this process or in another process.

Invariant: the output files depend only on the bytes of the recording, the steps, the formats and
the software version. All files become visible together, after all steps have succeeded.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import tempfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jointfit_daemon import __version__

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.session_data import SessionData

STEPS = ("calibrate", "replay", "export", "report")
"""Steps in the order in which they run."""
REPORT_FILE, CALIBRATION_FILE = "report.html", "calibration.json"
_NAMED_GAPS = 5
"""Number of gaps that a summary row lists. Additional gaps are only counted."""
MARKS = ".done"
"""Name of a folder in the output folder. Its files mark the processed recordings."""


@dataclass(frozen=True, slots=True)
class RecordingTask:
    """One recording and the steps to run on it.

    Paths are the same on all computers of a cluster.
    """

    name: str
    """Name of the recording in the summary, and name of its output folder."""
    parts: tuple[str, ...]
    """Paths of the parts of the recording, in their order."""
    out: str
    """Output folder of the batch."""
    steps: tuple[str, ...]
    formats: tuple[str, ...]
    """Formats of the step ``export``."""


@dataclass(frozen=True, slots=True)
class RecordingResult:
    """Result of one recording: a row of the summary."""

    recording: str
    status: str
    """``done``, ``failed``, or ``differs`` if the replay differs from the recorded run."""
    duration_s: float | None = None
    angle: str = ""
    """Name of the joint angle to which `rms_deg` refers."""
    rms_deg: float | None = None
    """RMS difference of the angle `angle` between sensors and cameras, degrees."""
    range_deg: float | None = None
    """Largest range of motion among all angles, degrees."""
    gait_cycles: int | None = None
    lost_percent: float | None = None
    """Share of lost samples of the source with the largest loss, percent."""
    faults: int | None = None
    verified: str = ""
    """Result of the step ``replay`` as text; empty if this step is not part of the task."""
    gaps: str = ""
    """Missing parts of the recording."""
    notes: str = ""
    error: str = ""


def task_digest(task: RecordingTask) -> str:
    """Return the SHA-256 of the recording's bytes, the settings and the software version.

    Raises
    ------
    OSError
        A part cannot be read.
    """
    settings = [__version__, task.name, task.steps, task.formats]
    found = hashlib.sha256(json.dumps(settings).encode())
    for part in task.parts:
        with Path(part).open("rb") as file:
            found.update(hashlib.file_digest(file, "sha256").digest())
    return found.hexdigest()


def finished_result(task: RecordingTask, digest: str) -> RecordingResult | None:
    """Return the stored result of a task; None if the task must run."""
    mark = _mark(task)
    try:
        stored: dict[str, Any] = json.loads(mark.read_bytes())
        if stored.pop("digest") != digest or not (Path(task.out) / task.name).is_dir():
            return None
        return RecordingResult(**stored)
    except (OSError, ValueError, TypeError, KeyError):
        return None  # the mark does not exist, or another version of this program wrote the mark


def process_recording(task: RecordingTask) -> RecordingResult:
    """Run the steps of a task unless their result is stored. An error becomes a failed result."""
    try:
        digest = task_digest(task)
        known = finished_result(task, digest)
        if known is not None:
            return known
        return _process(task, digest)
    except (ValueError, OSError, ImportError, LookupError) as error:
        return RecordingResult(task.name, "failed", error=f"{error}")
    except Exception as error:  # noqa: BLE001 - a fault in one recording stops only this recording
        return RecordingResult(task.name, "failed", error=f"{type(error).__name__}: {error}")


def _process(task: RecordingTask, digest: str) -> RecordingResult:
    out = Path(task.out)
    target = out / task.name
    target.parent.mkdir(parents=True, exist_ok=True)
    _mark(task).unlink(missing_ok=True)

    # The outputs of an interrupted run remain in a hidden folder, which no other step reads.
    staging = Path(tempfile.mkdtemp(prefix=f".partial-{target.name}-", dir=target.parent))
    try:
        result = _run_steps(task, staging)
        shutil.rmtree(target, ignore_errors=True)
        staging.chmod(0o755)
        staging.replace(target)
    finally:
        shutil.rmtree(staging, ignore_errors=True)

    mark = _mark(task)
    mark.parent.mkdir(parents=True, exist_ok=True)
    partial = mark.with_suffix(f".{staging.name[-8:]}.part")
    partial.write_text(json.dumps({"digest": digest, **asdict(result)}), encoding="utf-8")
    partial.replace(mark)
    return result


def _run_steps(task: RecordingTask, folder: Path) -> RecordingResult:
    from jointfit_daemon.reprocessing import load_session, verify_recording
    from jointfit_daemon.tools.export import load_data

    recording, notes = Path(task.parts[0]), list[str]()
    calibration = _calibrate(recording, folder, notes) if "calibrate" in task.steps else None
    verification = verify_recording(recording) if "replay" in task.steps else None
    if calibration is None:
        session = load_data(recording)
    else:
        session = load_session(recording, calibration=calibration)
    if "export" in task.steps:
        from jointfit_daemon.files.sessions import NothingToWriteError, write_session

        for name in task.formats:
            try:
                notes += write_session(session, folder, name).notes
            except NothingToWriteError as nothing:  # a recording without cameras has no markers
                notes.append(f"{name}: {nothing}")

    if "report" in task.steps:
        from jointfit_daemon.tools.report.page import render_report

        (folder / REPORT_FILE).write_text(render_report(session), encoding="utf-8")
    result = _measure_session(task, session, "; ".join(notes))
    if verification is None:
        return result
    status = "done" if verification.passed else "differs"
    return replace(result, status=status, verified="; ".join(verification.result_lines()))


def _calibrate(recording: Path, folder: Path, notes: list[str]) -> Calibration | None:
    """Write and return the calibration; if the recording yields none, add a note instead."""
    from jointfit_daemon.reprocessing import ReprocessingError, calibrate_recording
    from jointfit_daemon.tools.calibrate import store_offline_calibration

    try:
        found = calibrate_recording(recording)
    except ReprocessingError as error:  # many recordings contain no calibration
        notes.append(f"calibrate: {error}")
        return None
    if found.calibration is None:
        notes.append(f"calibrate: {found.rejected or 'no phase ended with a calibration'}")
        return None
    store_offline_calibration(found, folder / CALIBRATION_FILE)
    return found.calibration


def _measure_session(task: RecordingTask, session: SessionData, notes: str) -> RecordingResult:
    """Return the summary row of a session."""
    from jointfit_daemon.tools.report.session_results import analyze_session

    results = analyze_session(session)
    main = results.differences[0] if results.differences else None
    losses = [found.lost_share for found in results.sources.values()]
    known = [share for share in losses if math.isfinite(share)]
    extents = [found.extent for found in results.ranges]

    # List the first missing parts of the recording with their times, and count the other parts.
    missing = [event for event in session.events if event.kind == "gap"]
    gaps = [f"at {gap.t_s:.3f} s: {gap.text}" for gap in missing[:_NAMED_GAPS]]
    if len(missing) > _NAMED_GAPS:
        gaps.append(f"{len(missing) - _NAMED_GAPS} more gaps")
    return RecordingResult(
        task.name,
        "done",
        duration_s=round(session.duration_s, 3),
        angle="" if main is None else f"{main.joint} {main.angle}",
        rms_deg=None if main is None else round(math.degrees(main.rms), 3),
        range_deg=round(math.degrees(max(extents)), 2) if extents else None,
        gait_cycles=sum(len(gait.cycles_s) for gait in results.gait.values()),
        lost_percent=round(100.0 * max(known), 3) if known else None,
        faults=results.faults,
        gaps="; ".join(gaps),
        notes=notes,
    )


def _mark(task: RecordingTask) -> Path:
    return Path(task.out) / MARKS / f"{task.name.replace('/', '__')}.json"
