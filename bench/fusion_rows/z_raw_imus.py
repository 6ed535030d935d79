"""Row E-1: orientation from raw readings, through the driver, against optics and the package."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from bench import raw_wires
from bench.experiment import Experiment, Figure
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from pathlib import Path

GOALS_DEG = dict(zip(raw_wires.TRIALS, (1.5, 1.9), strict=True))
ROUNDING_DEG = 1e-6
"""What of a difference is rounding, not another filter."""


def raw_orientation(data: Path) -> list[Figure]:
    """E-1: bytes of gyroscope, accelerometer and magnetometer in, orientations out."""
    figures = []
    for name in raw_wires.TRIALS:
        trial = raw_wires.load(data, name)
        said = raw_wires.through_driver(trial.felt, magnetometer=True)
        moving = trial.moving & np.isfinite(trial.optical[:, 0])
        error = rotation.angle_between(said[moving], trial.optical[moving])
        rms = float(np.rad2deg(np.sqrt(np.mean(error**2))))
        figures.append(Figure(f"{name[:2]} against optics, RMS", rms, GOALS_DEG[name]))
        for magnetometer, kind in ((True, "9D"), (False, "6D")):
            off = _from_package(trial, said if magnetometer else None, kind)
            figures.append(Figure(f"{name[:2]} {kind} against the package", off, ROUNDING_DEG))
    return figures


def _from_package(trial: raw_wires.BoardTrial, said: raw_wires.Array | None, kind: str) -> float:
    """Return the largest angle between the driver's orientations and the package's, deg."""
    felt = trial.felt if said is not None else trial.felt[:2]
    if said is None:
        said = raw_wires.through_driver(felt, magnetometer=False)
    package = import_module("vqf").VQF(raw_wires.PERIOD_NS / 1e9)
    direct = package.updateBatch(*felt)[f"quat{kind}"]
    if said.shape != direct.shape:
        return float("inf")
    return float(np.rad2deg(rotation.angle_between(said, direct).max()))


EXPERIMENTS = (
    Experiment(
        "E-1",
        "orientation on the gateway from raw readings, whole trials",
        raw_orientation,
        recordings=("broad",),
        packages=("vqf", "h5py"),
        long=True,
    ),
)
