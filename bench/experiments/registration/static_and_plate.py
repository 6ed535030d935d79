"""Detection of rest, the mean orientation of a static pose, and the alignment on a plate.

The alignment estimates two rotations: q_W from the sensor's world to the optical world, and q_B
from the sensor to the body.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from bench.baselines.recorded_stillness import still_from_rates
from bench.framework.experiment import Experiment, Result, median_and_worst
from bench.framework.material import BOARD, SEEDED
from jointfit_daemon.calibration.registration import (
    fit_observable_alignment,
    fit_sensor_alignment,
    robust_mean,
)
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

TRIALS = ("02_undisturbed_slow_rotation_B", "07_undisturbed_fast_rotation_B")
INFINITY = float("inf")


def _degrees(angle: object) -> float:
    return float(np.rad2deg(np.asarray(angle, dtype=np.float64)))


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def stillness(data: Path) -> list[Result]:
    """Measure the shares of rest and of motion that are detected as rest, in two board trials."""
    h5py = import_module("h5py")  # imported by this experiment only
    figures = []
    for name in TRIALS:
        with h5py.File(data / "broad" / f"{name}.hdf5") as trial:
            moving = trial["movement"][:].astype(bool)
            rate = float(trial.attrs["sampling_rate"])
            still = still_from_rates(trial["imu_gyr"][:], trial["imu_acc"][:], rate)
        figures += [
            Result(
                f"{name[15:19]} trial: at rest", float(still[~moving].mean()), INFINITY, 0.97, ""
            ),
            Result(f"{name[15:19]} trial: in motion", float(still[moving].mean()), 0.002, unit=""),
        ]
    return figures


def static_mean(_: Path) -> list[Result]:
    """Measure the error of the mean of 500 orientations with noise of 1 degree per axis.

    A fifth of the orientations are outliers, which differ from the truth by 30 to 90 degrees.
    """
    rng = np.random.default_rng(2)
    errors = []
    for _run in range(100):
        truth = rotation.exp(rng.normal(size=3))
        q = rotation.multiply(truth, rotation.exp(np.deg2rad(1.0) * rng.normal(size=(500, 3))))
        wrong = rng.choice(500, 100, replace=False)
        axes = rng.normal(size=(100, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        turns = rotation.exp(axes * np.deg2rad(rng.uniform(30, 90, (100, 1))))
        q[wrong] = rotation.multiply(truth, turns)
        errors.append(_degrees(rotation.angle_between(robust_mean(q).q, truth)))
    return [
        Result("RMS error", _rms(errors), 0.18),
        *median_and_worst("error of a run", errors),
    ]


def random_walk(
    rng: np.random.Generator, outliers: float = 0.0, axis: tuple[float, ...] | None = None
) -> tuple[Array, Array, Array, Array]:
    """Return orientations of sensor and body of a hand-held plate, and the true q_W and q_B."""
    n, steps = 2000, rng.normal(0.0, 0.05, (1999, 3))
    if axis is not None:
        steps = steps[:, :1] * np.array(axis)
    q_s = np.empty((n, 4))
    q_s[0] = rotation.IDENTITY
    for i, step in enumerate(rotation.exp(steps)):
        q_s[i + 1] = rotation.multiply(q_s[i], step)
    q_world, q_mount = rotation.exp(rng.normal(size=3)), rotation.exp(rng.normal(size=3))
    noise = rotation.exp(np.deg2rad(1.0) * rng.normal(size=(n, 3)))
    q_body = rotation.multiply(rotation.multiply(rotation.multiply(q_world, q_s), q_mount), noise)
    wrong = rng.random(n) < outliers
    q_body[wrong] = rotation.normalize(rng.normal(size=(int(wrong.sum()), 4)))
    return q_s, q_body, q_world, q_mount


def plate(_: Path) -> list[Result]:
    """Measure the errors of q_W and q_B on a plate, without outliers and with 15 % outliers."""
    figures = []
    for share, label in ((0.0, "clean"), (0.15, "15 % outliers")):
        world, mount = [], []
        for seed in range(10):
            q_s, q_body, q_world, q_mount = random_walk(np.random.default_rng(seed), share)
            found = fit_sensor_alignment("full", q_s, q_body)
            world.append(_degrees(rotation.angle_between(found.q_world, q_world)))
            mount.append(_degrees(rotation.angle_between(found.q_mount, q_mount)))
        for name, errors in (("world-to-world", world), ("sensor-to-segment", mount)):
            figures.append(Result(f"{label}: {name}", _rms(errors), 0.15))
            figures += median_and_worst(f"{label}: {name}", errors)
    return figures


def one_axis(_: Path) -> list[Result]:
    """Check that a rotation about one axis only is rejected."""
    q_s, q_body, *_truth = random_walk(np.random.default_rng(4), axis=(1.0, 0.0, 0.0))
    found = fit_observable_alignment(q_s, q_body)
    kappa = fit_sensor_alignment("full", q_s, q_body).kappa
    return [
        Result("kappa", kappa, 1.0, 0.999, ""),
        Result("full fit accepted", float(found.kind == "full"), 0.0, unit=""),
    ]


def _aligned(q_s: Array, q_opt: Array, kept: slice) -> list[Result]:
    rng = np.random.default_rng(5)
    q_world, q_mount = rotation.exp(rng.normal(size=3)), rotation.exp(rng.normal(size=3))
    q_body = rotation.multiply(rotation.multiply(q_world, q_opt), q_mount)
    found = fit_observable_alignment(q_s[kept], q_body[kept])
    return [
        Result("world-to-world", _degrees(rotation.angle_between(found.q_world, q_world)), 1.5),
        Result("sensor-to-segment", _degrees(rotation.angle_between(found.q_mount, q_mount)), 1.0),
        Result("full fit rejected", float(found.kind != "full"), 0.0, unit=""),
    ]


def real_plate(data: Path) -> list[Result]:
    """Align a recorded board; a filter computes its IMU orientation; 30 s of motion at 47.6 Hz."""
    h5py, vqf = import_module("h5py"), import_module("vqf")  # imported by this experiment only
    with h5py.File(data / "broad" / f"{TRIALS[0]}.hdf5") as trial:
        rate = float(trial.attrs["sampling_rate"])
        columns = [np.ascontiguousarray(trial[f"imu_{kind}"][:]) for kind in ("gyr", "acc", "mag")]
        q_opt, moving = trial["opt_quat"][:], trial["movement"][:].astype(bool)
    q_s = vqf.VQF(1.0 / rate).updateBatch(*columns)["quat9D"]
    first = int(np.flatnonzero(moving)[0])
    return _aligned(q_s, q_opt, slice(first, first + int(30 * rate), 6))


def integrated_plate(data: Path) -> list[Result]:
    """Align a recorded board, whose IMU orientation is the integral of the angular rate.

    The data are 30 s, which begin 5 s after the start of the motion.
    """
    with np.load(data / "broad_excerpts" / f"{TRIALS[0]}_60s.npz", allow_pickle=False) as trial:
        rate = float(trial["sampling_rate"])
        gyr = trial["imu_gyr"].astype(np.float64)
        q_opt = rotation.normalize(trial["opt_quat"])
        first = int(np.flatnonzero(trial["movement"])[0])
    rates = gyr - gyr[:first].mean(axis=0)
    steps = rotation.exp(0.5 * (rates[1:] + rates[:-1]) / rate)
    # The integration starts from the optical orientation, so both worlds are equal.
    q_s = q_opt.copy()
    for i in range(first, len(steps)):
        q_s[i + 1] = rotation.multiply(q_s[i], steps[i])
    begin = first + int(5 * rate)
    return _aligned(rotation.normalize(q_s), q_opt, slice(begin, begin + int(30 * rate), 6))


EXPERIMENTS = (
    Experiment(
        "stillness-detection",
        "Share of samples detected as still, at rest and in motion",
        stillness,
        BOARD,
        ("broad",),
        ("h5py",),
    ),
    Experiment(
        "static-mean-outliers",
        "Mean orientation with a fifth of the frames wrong, 100 runs",
        static_mean,
        SEEDED,
    ),
    Experiment(
        "plate-alignment-simulated",
        "Alignment on a plate turned by hand, 10 simulated runs",
        plate,
        SEEDED,
    ),
    Experiment(
        "plate-alignment-single-axis",
        "Alignment on a plate turned about one axis only, one run",
        one_axis,
        SEEDED,
    ),
    Experiment(
        "board-alignment-filtered",
        "Alignment of a recorded board; its IMU orientation is computed by a filter",
        real_plate,
        BOARD,
        ("broad",),
        ("h5py", "vqf"),
    ),
    Experiment(
        "board-alignment-integrated",
        "Alignment of a recorded board; the IMU orientation is the integral of the angular rate",
        integrated_plate,
        BOARD,
        ("broad_excerpts",),
        headline=True,
    ),
)
