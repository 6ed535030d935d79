"""Inverse kinematics of OpenSim, the reference for refined marker sets.

Invariant: joints and scaling of the model are those of its file. Only the positions of the markers
on their bodies are replaced. All markers have the weight 1. Forces are removed, because they need
time and inverse kinematics does not use them.
"""

from __future__ import annotations

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.subjects.model_joint_centers import quiet
from jointfit_daemon.calibration.marker_refinement import Carriers
from jointfit_daemon.files.axes import from_z_up
from jointfit_daemon.files.mocap import MarkerTrajectories, read_trc, write_trc
from jointfit_daemon.files.orientations import read_sto

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.kinematics.chains import ChainModel

_ACCURACY = 1e-5
"""Default accuracy of InverseKinematicsTool."""
CONVERGED = 1e-7
"""Accuracy at which the errors have converged. These errors differ by less than 2 micrometres from
the errors at 1e-9."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Errors of a model after inverse kinematics of a trial."""

    frame_rms: NDArray[np.float64]
    """RMS error over the visible markers of each frame, m."""
    rms: float
    """RMS error over all frames, m."""
    coordinates: NDArray[np.float64]
    """Coordinates of every frame, rad (translations in m), shape (frames, coordinates)."""
    seconds: float

    @property
    def variance(self) -> float:
        """Variance of the frames' RMS errors over time, m²."""
        return float(np.var(self.frame_rms))


def trial_frames(path: Path, names: Sequence[str], every: int = 1) -> MarkerTrajectories:
    """Return the markers `names` in each `every`-th frame of a TRC file, in the file's axes."""
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
    """Return the common markers of model and trial, in the order of the model."""
    import opensim  # noqa: PLC0415 - optional, and slow to import

    opensim.Logger.setLevelString("off")
    loaded = opensim.Model(os.fspath(model))
    in_trial = set(read_trc(trial).names) - set(leave_out)
    return tuple(m.getName() for m in loaded.getMarkerSet() if m.getName() in in_trial)


def judge(
    model: Path,
    trial: MarkerTrajectories,
    refined: ChainModel | None = None,
    accuracy: float = _ACCURACY,
) -> Verdict:
    """Run InverseKinematicsTool with unit weights on the markers of a trial.

    Parameters
    ----------
    model
        An .osim file, which is not changed.
    trial
        Markers and frames to evaluate, in the axes of OpenSim.
    refined
        Model with refined marker positions; the default is the positions in `model`.
    accuracy
        Accuracy at which the tool stops.
    """
    import opensim  # noqa: PLC0415 - optional, and slow to import

    opensim.Logger.setLevelString("off")
    with tempfile.TemporaryDirectory() as name, quiet():
        folder = Path(name)
        loaded = without_forces(model)
        if refined is not None:
            places = dict(zip(refined.marker_names, from_z_up(refined.positions), strict=True))
            place(loaded, places, [m.segment for m in refined.markers])
        loaded.finalizeConnections()
        loaded.printToXML(os.fspath(folder / "model.osim"))
        write_trc(folder / "trial.trc", trial)
        tool = opensim.InverseKinematicsTool()
        tool.set_accuracy(accuracy)
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
    total = errors.values[:, errors.columns.index("total_squared_error")]
    seen = np.isfinite(trial.positions).all(axis=-1).sum(axis=1)
    rms = float(np.sqrt(total.sum() / seen.sum()))
    return Verdict(np.sqrt(total / seen), rms, turns, seconds)


def without_forces(model: Path) -> Any:
    """Return an OpenSim model without forces."""
    import opensim  # noqa: PLC0415 - optional, and slow to import

    loaded = opensim.Model(os.fspath(model))
    loaded.updForceSet().clearAndDestroy()
    loaded.updControllerSet().clearAndDestroy()
    return loaded


def place(
    model: Any, places: Mapping[str, NDArray[np.float64]], bodies: Sequence[str] | None = None
) -> None:
    """Move markers of a loaded model on their bodies or to other bodies."""
    import opensim  # noqa: PLC0415 - optional, and slow to import

    markers = model.updMarkerSet()
    for i, (name, at) in enumerate(places.items()):
        marker = markers.get(name)
        marker.set_location(opensim.Vec3(*map(float, at)))
        if bodies is not None:
            marker.setParentFrame(model.getBodySet().get(bodies[i]))


class OpenSimFollower:
    """OpenSim model that follows a trial repeatedly with different marker positions.

    Positions and poses are in the axes of this project (z up). Bodies are rotated accordingly.
    """

    def __init__(self, model: Path, trial: MarkerTrajectories, segments: Sequence[str]) -> None:
        import opensim  # noqa: PLC0415 - optional, and slow to import

        opensim.Logger.setLevelString("off")
        self._opensim: Any = opensim
        self._model = without_forces(model)
        self._trial = trial
        self._segments = tuple(segments)
        self._folder = tempfile.TemporaryDirectory()
        path = Path(self._folder.name) / "trial.trc"
        write_trc(path, trial)
        self._measured = opensim.MarkersReference(os.fspath(path), opensim.SetMarkerWeights())
        self.runs = 0

    def __call__(self, positions: NDArray[np.float64], _weights: Any = None) -> Carriers:
        """Return the poses of the bodies that carry the markers, in every frame."""
        poses, _ = self._run(positions)
        at = [sorted(set(self._segments)).index(s) for s in self._segments]
        turned = poses[:, at][:, :, [2, 0, 1]]  # y up to z up
        return Carriers(turned[..., [2, 0, 1]], turned[..., 3])

    def tracking_error(self, positions: NDArray[np.float64]) -> float:
        """Return the RMS distance of model and measured markers after inverse kinematics, m."""
        return float(np.sqrt(self._run(positions, poses=False)[1].mean()))

    def _run(
        self, positions: NDArray[np.float64], *, poses: bool = True
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return body poses, shape (T, B, 3, 4), and squared errors of the visible markers, m²."""
        opensim, model = self._opensim, self._model
        self.runs += 1
        place(
            model, dict(zip(self._trial.names, from_z_up(positions), strict=True)), self._segments
        )
        state = model.initSystem()
        solver = opensim.InverseKinematicsSolver(
            model, self._measured, opensim.SimTKArrayCoordinateReference()
        )
        solver.setAccuracy(_ACCURACY)
        found: list[list[list[list[float]]]] = []
        squared: list[float] = []
        bodies = [model.getBodySet().get(name) for name in sorted(set(self._segments))]
        errors = opensim.SimTKArrayDouble()
        for frame, t in enumerate(self._trial.t_s):
            state.setTime(float(t))
            (solver.track if frame else solver.assemble)(state)
            solver.computeCurrentSquaredMarkerErrors(errors)
            row = (errors.getElt(i) for i in range(errors.size()))
            squared += [value for value in row if np.isfinite(value)]
            if poses:
                model.realizePosition(state)
                found.append([_pose(body.getTransformInGround(state)) for body in bodies])
        return np.array(found), np.array(squared)


def _pose(transform: Any) -> list[list[float]]:
    turn, at = transform.R(), transform.p()
    return [[*(turn.get(i, j) for j in range(3)), at.get(i)] for i in range(3)]
