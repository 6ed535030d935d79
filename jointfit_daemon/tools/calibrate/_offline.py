"""Option ``--recording`` of `jointfit calibrate`: repeats the calibration of a recorded session."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from jointfit_daemon.tools.activity import show_activity
from jointfit_daemon.tools.output_files import check_output

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.pipeline.events import CalibrationStatus
    from jointfit_daemon.reprocessing import OfflineCalibration


def calibrate_offline(recording: Path, rig: Path | None, out: Path | None) -> dict[str, object]:
    """Repeat the calibration of a recording and store its result.

    Parameters
    ----------
    recording
        Path of the recording.
    rig
        A rig.toml that replaces the recorded rig.toml.
    out
        File of the result. The default is a new version in the calibration store of the rig.

    Returns
    -------
    dict
        ``text``, ``quality`` and ``kept`` as in the payload of the topic ``calibration``.

    Raises
    ------
    ConfigError, ValueError, OSError
        Rig, recording or output cannot be used, or no phase ended with a result.
    """
    from jointfit_daemon.config import load_rig
    from jointfit_daemon.outputs.payloads import quality_payload
    from jointfit_daemon.reprocessing import calibrate_recording

    check_output("--out", out, (".json",))
    other = None if rig is None else load_rig(rig)
    last = ""

    with show_activity("calibrating") as print_line:

        def report(seconds: float, status: CalibrationStatus) -> None:
            nonlocal last
            last = f"{status.phase}: {status.text}"
            print_line(f"{seconds:9.3f} s  {last}")

        found = calibrate_recording(recording, other, report)
    if found.calibration is None and found.rejected is None:
        raise ValueError(
            f"{recording}: no phase ended with a calibration; the last status is {last!r}"
        )
    text = "no new calibration"
    if found.calibration is not None:
        text = store_offline_calibration(found, out)
    return {"text": text, "quality": quality_payload(found.quality), "kept": found.rejected}


def store_offline_calibration(found: OfflineCalibration, out: Path | None = None) -> str:
    """Write the calibration to `out` or to the rig's store; return a sentence with the location.

    Raises
    ------
    OSError
        The medium is full, read-only or missing. No partial file remains.
    """
    from jointfit_daemon.calibration.record import CalibrationStore, calibration_text
    from jointfit_daemon.supervisor.state_directory import PRIVATE_UMASK, state_directory

    calibration = found.calibration
    if calibration is None:
        raise ValueError("there is no calibration to store")
    before = os.umask(PRIVATE_UMASK)
    try:
        if out is None:
            folder = state_directory() / "calibrations"
            store = CalibrationStore(folder, found.rig.calibration_store)
            version = store.save(calibration)
            return (
                f"stored as version {version} in {store.path(version)}; a running daemon uses it "
                f"after `jointfit calibrate --use {version}`"
            )
        aside = out.with_name(f".{out.name}.writing")
        try:
            aside.write_text(calibration_text(calibration), encoding="utf-8")
            aside.replace(out)
        finally:
            aside.unlink(missing_ok=True)
        return f"written to {out}"
    finally:
        os.umask(before)
