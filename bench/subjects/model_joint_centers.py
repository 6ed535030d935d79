"""Joint centers of musculoskeletal models in recorded trials, computed by OpenSim.

Invariant: the reference is independent. Its model was scaled by others, has poses from inverse
kinematics, and shares no code with the estimators. The reference is not ground truth: the hip of a
model is from a regression or a scaling factor, and its joints follow skin markers.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from contextlib import chdir, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.files.axes import to_z_up
from jointfit_daemon.files.mocap import read_marker_trial
from jointfit_daemon.files.orientations import TimeTable, read_sto

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from jointfit_daemon.files.mocap import MarkerTrial

_EVERY = {"squats1": 5, "STS1": 5}
"""Step between the computed model poses, frames."""


@dataclass(frozen=True, slots=True)
class ModelTrial:
    """Marker trial, and joint positions of a model in this trial."""

    markers: MarkerTrial
    frames: NDArray[np.int64]
    """Indices of the frames of `markers` to which the model was fitted."""
    centers: dict[str, NDArray[np.float64]]
    """Joint centers in the world (z up), m, shape (len(frames), 3), by joint of the model."""


@cache
def opencap(data: Path, trial: str) -> ModelTrial:
    """Return a trial of OpenCap subject 4 with the manually scaled model."""
    folder = data / "opencap_subject4"
    motion = folder / "ik" / f"{trial}_manual_scaling_ik.mot"
    model = folder / "models" / "manually_scaled.osim"
    markers = read_marker_trial(folder / "trc" / f"{trial}.trc")
    joints = ("hip_r", "hip_l", "walker_knee_r", "walker_knee_l")
    return _followed(markers, model, motion, joints, _EVERY.get(trial, 1))


@cache
def gait2354(data: Path) -> ModelTrial:
    """Return the walking trial of OpenSim's gait2354 after inverse kinematics, 0.4 to 1.6 s."""
    import opensim  # noqa: PLC0415 - optional, and slow to import

    source = data / "opensim_gait2354"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(shutil.copytree(source, Path(name) / "gait"))
        for path in (folder, *folder.iterdir()):
            path.chmod(0o755)
        with chdir(folder), quiet():
            opensim.Logger.setLevelString("off")
            opensim.InverseKinematicsTool("subject01_Setup_IK.xml").run()
            motion = next(path for path in folder.glob("*.mot") if "ik" in path.name.lower())
        markers = read_marker_trial(folder / "subject01_walk1.trc")
        joints = ("hip_r", "hip_l", "knee_r", "knee_l")
        return _followed(markers, folder / "subject01_simbody.osim", motion, joints, 1)


@contextmanager
def quiet() -> Iterator[None]:
    """Keep the output of C++ code out of standard output, which contains the tables."""
    sys.stdout.flush()
    kept, sink = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(sink)


def _followed(
    markers: MarkerTrial, model: Path, motion: Path, joints: tuple[str, ...], every: int
) -> ModelTrial:
    table = read_sto(motion)
    rate = markers.trajectories.rate_hz
    first = markers.trajectories.t_s[0]
    frames = np.rint((table.t_s - first) * rate).astype(np.int64)[::every]
    return ModelTrial(markers, frames, _positions(model, table, every, joints))


def _positions(
    path: Path, table: TimeTable, every: int, joints: tuple[str, ...]
) -> dict[str, NDArray[np.float64]]:
    """Return the origin of every joint's child frame in every pose, m, z up, shape (n, 3)."""
    import opensim  # noqa: PLC0415 - optional, and slow to import

    opensim.Logger.setLevelString("off")
    model: Any = opensim.Model(os.fspath(path))
    state = model.initSystem()
    coordinates = model.getCoordinateSet()
    found: dict[str, list[NDArray[np.float64]]] = {name: [] for name in joints}
    turns = {c.getName(): c.getMotionType() == opensim.Coordinate.Rotational for c in coordinates}
    scale = [np.pi / 180.0 if table.in_degrees and turns.get(c) else 1.0 for c in table.columns]
    for row in table.values[::every] * scale:
        for name, value in zip(table.columns, row, strict=True):
            if name in turns:
                coordinates.get(name).setValue(state, float(value), False)
        model.assemble(state)
        model.realizePosition(state)
        for name in joints:
            child = model.getJointSet().get(name).getChildFrame()
            found[name].append(child.getPositionInGround(state).to_numpy())
    return {name: to_z_up(np.array(rows)) for name, rows in found.items()}
