"""OpenSim's own inverse kinematics: the judge of refined marker sets.

Law: the judge keeps its own model. Joints, scaling and weights stay as their file has them; only
the places of markers on their bodies are ours. Forces are taken out: inverse kinematics has no use
for them, and they cost time.
"""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.model_joints import quiet
from jointfit_daemon.files.sto import read_sto
from jointfit_daemon.files.trc import MarkerTrajectories, read_trc, write_trc

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Verdict:
    """How well a model followed a trial."""

    frame_rms: NDArray[np.float64]
    """RMS over the markers of every frame, m."""
    coordinates: NDArray[np.float64]
    """Joint angles of every frame, rad (translations, m), shape (frames, coordinates)."""
    seconds: float

    @property
    def rms(self) -> float:
        """RMS over all frames, m."""
        return float(np.sqrt(np.mean(self.frame_rms**2)))

    @property
    def variance(self) -> float:
        """Variance of the frames' RMS over time, m²."""
        return float(np.var(self.frame_rms))


def trial_frames(path: Path, names: Sequence[str], every: int = 1) -> MarkerTrajectories:
    """Return some markers and some frames of a TRC, in its own axes."""
    trial = read_trc(path)
    at = [trial.names.index(name) for name in names]
    return MarkerTrajectories(
        tuple(names),
        trial.t_s[::every],
        trial.frames[::every],
        trial.positions[::every][:, at],
        trial.rate_hz / every,
    )


def shared_markers(model: Path, trial: Path, leave_out: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the markers that model and trial both have, in the model's order."""
    import opensim  # noqa: PLC0415 - optional, and slow to import

    opensim.Logger.setLevelString("off")
    loaded = opensim.Model(os.fspath(model))
    in_trial = set(read_trc(trial).names) - set(leave_out)
    return tuple(m.getName() for m in loaded.getMarkerSet() if m.getName() in in_trial)


def judge(
    model: Path, trial: MarkerTrajectories, places: Mapping[str, NDArray[np.float64]] | None = None
) -> Verdict:
    """Run InverseKinematicsTool, unit weights, on the markers of a trial.

    Parameters
    ----------
    model
        An .osim file, left as it is.
    places
        Where markers are on their bodies, m, by name; the model's own where not given.
    """
    import opensim  # noqa: PLC0415 - optional, and slow to import

    opensim.Logger.setLevelString("off")
    with tempfile.TemporaryDirectory() as name, quiet():
        folder = Path(name)
        loaded = without_forces(model)
        place(loaded, places or {})
        loaded.finalizeConnections()
        loaded.printToXML(os.fspath(folder / "model.osim"))
        write_trc(folder / "trial.trc", trial)
        tool = opensim.InverseKinematicsTool()
        tool.set_model_file(os.fspath(folder / "model.osim"))
        tool.setMarkerDataFileName(os.fspath(folder / "trial.trc"))
        tool.setOutputMotionFileName(os.fspath(folder / "ik.mot"))
        tool.setResultsDir(name)
        tool.setStartTime(float(trial.t_s[0]))
        tool.setEndTime(float(trial.t_s[-1]))
        tasks = opensim.IKTaskSet()
        for marker in trial.names:
            task = opensim.IKMarkerTask()
            task.setName(marker)
            task.setApply(True)
            task.setWeight(1.0)
            tasks.cloneAndAppend(task)
        tool.set_IKTaskSet(tasks)
        began = time.perf_counter()
        tool.run()
        seconds = time.perf_counter() - began
        errors = read_sto(next(folder.glob("*ik_marker_errors.sto")))
        motion = read_sto(folder / "ik.mot")
    turns = np.radians(motion.values) if motion.in_degrees else motion.values
    return Verdict(errors.values[:, errors.columns.index("marker_error_RMS")], turns, seconds)


def without_forces(model: Path) -> Any:
    """Return an OpenSim model of kinematics alone."""
    import opensim  # noqa: PLC0415 - optional, and slow to import

    loaded = opensim.Model(os.fspath(model))
    loaded.updForceSet().clearAndDestroy()
    loaded.updControllerSet().clearAndDestroy()
    return loaded


def place(model: Any, places: Mapping[str, NDArray[np.float64]]) -> None:
    """Move markers of a loaded model on their bodies."""
    import opensim  # noqa: PLC0415 - optional, and slow to import

    markers = model.updMarkerSet()
    for name, at in places.items():
        markers.get(name).set_location(opensim.Vec3(*map(float, at)))
