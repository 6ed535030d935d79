"""Orientations that the gateway's driver computes from raw readings of a sensor.

The orientations are compared with optical data, and with the output of the filter package without
the driver. Another result is the error if the filter starts while the sensor moves.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import Experiment, Result, median_and_worst
from bench.framework.material import BOARD
from bench.subjects import raw_imu_trials
from jointfit_daemon.kinematics import rotation
from jointfit_drivers.gateway_orientation import LONGEST_SETTLE_S

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

GOALS_DEG = dict(zip(raw_imu_trials.TRIALS, (1.5, 1.9), strict=True))
FAST = raw_imu_trials.TRIALS[1]
STARTS = 20
SECOND = round(1e9 / raw_imu_trials.PERIOD_NS)
SETTLED_GOAL_DEG = 4.0
"""Threshold for the RMS error of the first second with output, deg. Later, the RMS error is
2.8 deg."""
ROUNDING_DEG = 1e-6
"""Largest difference due to rounding, deg."""


def raw_orientation(data: Path) -> list[Result]:
    """Measure errors of orientations from bytes of gyroscope, accelerometer and magnetometer."""
    figures = []
    for name in raw_imu_trials.TRIALS:
        trial = raw_imu_trials.load(data, name)
        said = raw_imu_trials.through_driver(trial.felt, magnetometer=True)
        moving = trial.moving & np.isfinite(trial.optical[:, 0])
        error = rotation.angle_between(said[moving], trial.optical[moving])
        rms = float(np.rad2deg(np.sqrt(np.mean(error**2))))
        figures.append(
            Result(f"{name[15:19]} trial: RMS error against optics", rms, GOALS_DEG[name])
        )
        for magnetometer, kind in ((True, "9D"), (False, "6D")):
            off = _from_package(trial, said if magnetometer else None, kind)
            figures.append(
                Result(
                    f"{name[15:19]} trial, {kind}: largest difference to the VQF package",
                    off,
                    ROUNDING_DEG,
                )
            )
    return figures


def _from_package(trial: raw_imu_trials.BoardTrial, said: Array | None, kind: str) -> float:
    """Return the largest angle between the orientations of driver and package, deg."""
    felt = trial.felt if said is not None else trial.felt[:2]
    if said is None:
        said = raw_imu_trials.through_driver(felt, magnetometer=False)
    package = import_module("vqf").VQF(raw_imu_trials.PERIOD_NS / 1e9)
    direct = package.updateBatch(*felt)[f"quat{kind}"]
    if said.shape != direct.shape:
        return float("inf")
    return float(np.rad2deg(rotation.angle_between(said, direct).max()))


def begun_in_motion(data: Path) -> list[Result]:
    """Measure the RMS error in each second after a filter start; twenty starts in fast motion."""
    trial = raw_imu_trials.load(data, FAST)
    rng = np.random.default_rng(0)
    last = len(trial.moving) - 8 * SECOND
    chosen = rng.choice(np.flatnonzero(trial.moving[:last]), STARTS, replace=False)
    at_once: list[Array] = []
    settled: list[Array] = []
    for start in chosen:
        part = slice(int(start), int(start) + 7 * SECOND)
        felt = [values[part] for values in trial.felt]
        for settle_s, errors in ((0.0, at_once), (LONGEST_SETTLE_S, settled)):
            said = raw_imu_trials.through_driver(felt, magnetometer=True, settle_s=settle_s)
            # Orientations are withheld at the beginning only.
            optical = trial.optical[part][-len(said) :]
            errors.append(rotation.angle_between(said, optical)[: 3 * SECOND])
    figures = []
    for k in range(3):
        figures += _rms_deg(f"published at once: second {k + 1}", at_once, k)
    return figures + _rms_deg("settled: second 1", settled, 0, SETTLED_GOAL_DEG)


def _rms_deg(
    name: str, errors: list[Array], second: int, maximum: float = float("inf")
) -> list[Result]:
    """Return the RMS error of all starts together, and median and worst of the starts."""
    parts = [e[second * SECOND : (second + 1) * SECOND] for e in errors]
    together, *each = (
        float(np.rad2deg(np.sqrt(np.nanmean(part**2)))) for part in (np.concatenate(parts), *parts)
    )
    return [Result(name, together, maximum), *median_and_worst(name, each)]


EXPERIMENTS = (
    Experiment(
        "gateway-orientation-whole-trials",
        "Orientation filter on the gateway, raw readings of whole trials",
        raw_orientation,
        BOARD,
        recordings=("broad",),
        packages=("vqf", "h5py"),
        long=True,
    ),
    Experiment(
        "gateway-orientation-start-in-motion",
        "Error of an orientation filter started during fast motion, by second",
        begun_in_motion,
        BOARD,
        recordings=("broad",),
        packages=("vqf", "h5py"),
        long=True,
    ),
)
