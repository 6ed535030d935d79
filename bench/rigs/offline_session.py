"""Session of recorded movements with offline fit and fusion, without bytes, clocks or messages.

Invariant: the offline run uses the times of the daemon's frames, but no other output of the daemon.
The sensors have their recorded orientations at exactly these times. The models are fitted as
`jointfit fuse fit` does. The sensors are fused frame by frame as `jointfit fuse apply` does,
including the correction of headings and sensor pairs. The session includes the rest before the
movement, from which the daemon determines the headings, and the gaps of the recording.
"""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.phases import OfflineTrial, fit_offline
from jointfit_daemon.fusion import LimbFuser
from jointfit_daemon.model import Chain
from jointfit_daemon.timing.alignment import FrameAligner
from jointfit_simulators.body import SENSORS, RecordedSubject, Step, read_recorded_trial

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from jointfit_daemon.limb_model import Calibration, Method, Procedure
    from jointfit_daemon.model import LimbState

KNEE = Chain(("hip", "knee", "ankle"), ("thigh", "shank"), (("S1", "S2"), ("S3", "S4")))
BONES = {"thigh": "femur_r", "shank": "tibia_r"}
FLUSH_NS = 1_000_000_000


def calibrate(
    files: Sequence[Path], frames: int, method: Method, procedure: Procedure
) -> Calibration:
    """Fit a calibration to the first `frames` of a recording, with its static pose."""
    recording = read_recorded_trial(files)
    trial = recording.orientations
    training = OfflineTrial(
        "training", trial.t_s, trial.sensors, {name: trial.bones[b] for name, b in BONES.items()}
    ).part(slice(0, frames))
    mounts = {name: np.asarray(recording.biases[name]) for name in SENSORS}
    return replace(fit_offline(KNEE, [training], mounts, method), procedure=procedure)


def fuse_session(
    files: Sequence[Path],
    truth: Path,
    t_ns: Sequence[int],
    calibration: Calibration,
    transition_s: float,
) -> Mapping[int, LimbState]:
    """Return the limb states of a session by time, ns.

    Parameters
    ----------
    files : sequence of path
        Files of the recording.
    truth : path
        Log of the simulator with the ground truth and the motions of the session.
    t_ns : sequence of int
        Times of the frames at equal intervals, ns.
    calibration : Calibration
        Active calibration from the first frame on.
    transition_s : float
        Duration of the blend between motions, s.
    """
    subject, origin_ns = _subject(files, truth, transition_s)
    t_s = (np.array(t_ns) - origin_ns) * 1e-9
    seen = subject.observe([t_s] * len(SENSORS), np.zeros(0), np.zeros(0)).sensors
    columns = {name: q.tolist() for name, q in zip(SENSORS, seen, strict=True)}

    period_ns = t_ns[1] - t_ns[0]
    aligner = FrameAligner(dict.fromkeys(SENSORS, period_ns), period_ns, begin_ns=t_ns[0])
    fuser, states = LimbFuser(KNEE, calibration), {}
    for k, t in enumerate((*t_ns, t_ns[-1] + FLUSH_NS)):
        for name, column in columns.items():
            if k < len(column) and not np.isnan(column[k][0]):
                aligner.push(name, t, t, tuple(column[k]))
        for frame in aligner.advance(t):
            states[frame.t_ns] = fuser.fuse(
                frame.t_ns, t, k, frame.orientations, extrapolated=frame.extrapolated
            )
    return states


def _subject(
    files: Sequence[Path], truth: Path, transition_s: float
) -> tuple[RecordedSubject, int]:
    """Return the subject with the motions of a session, and the host time of its start, ns."""
    recording = read_recorded_trial(files)
    subject = RecordedSubject(recording, SENSORS, [Step("stand", 1.0)], transition_s=transition_s)
    header, *lines = truth.read_text(encoding="utf-8").splitlines()
    origin_ns, motion = json.loads(header)["t_ns"], "stand"
    for line in lines:
        row = json.loads(line)
        if row["motion"] != motion:
            motion = row["motion"]
            subject.play(motion, (row["t_ns"] - origin_ns) * 1e-9)
    return subject, origin_ns
