"""Inverse kinematics of a chain: Jacobian, errors for a recorded adult, and CPU time.

Times are median CPU times of one thread, as in the speed experiments.
"""

from __future__ import annotations

from functools import partial
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from bench.framework.experiment import Experiment, Result, near
from bench.framework.material import LOWER_LIMBS
from bench.framework.measurement import cpu_s
from bench.subjects.adult_lower_limbs import FOLDER, TRIALS, measured, oc4_lower
from bench.subjects.two_segments import swing, two_segments
from jointfit_daemon.kinematics.chains import apply_step, jacobian, marker_positions, step_between
from jointfit_daemon.kinematics.inverse_kinematics import (
    LiveInverseKinematics,
    solve_frames,
    tracking_error,
)

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel, ChainState

EXPECTED_MM = dict(zip(TRIALS, (2.37, 6.57, 10.61, 8.62, 11.29), strict=True))
REPEATS = 20
_ROOT_SHIFT = [3, 4, 5]


def slope(data: Path) -> list[Result]:
    """Compare the Jacobian with central differences at 5 frames of walking."""
    model = oc4_lower(data)
    state = solve_frames(model, measured(data, "walking1", model)[::26]).state
    told, h, off = jacobian(model, state), 1e-6, 0.0
    for k in range(model.nq):
        step = np.zeros((len(state), model.nq))
        step[:, k] = h
        ahead = marker_positions(model, apply_step(model, state, step))
        behind = marker_positions(model, apply_step(model, state, -step))
        off = max(off, float(np.abs(told[..., k] - (ahead - behind) / (2 * h)).max()))
    return [Result("largest difference", off, 1e-7, unit="m/rad")]


def fit(data: Path) -> list[Result]:
    """Measure the tracking error (RMS distance of measured and model markers) before refinement."""
    model = oc4_lower(data)
    figures = []
    for trial, expected in EXPECTED_MM.items():
        found = solve_frames(model, measured(data, trial, model))
        error = 1000 * tracking_error(found.residuals)
        figures.append(near(trial, error, expected, 0.05, "mm"))
    return figures


def exact(data: Path) -> tuple[ChainModel, ChainState, Array]:
    """Return the model, its walking poses, and the noise-free markers of these poses."""
    model = oc4_lower(data)
    truth = solve_frames(model, measured(data, "walking1", model)).state
    return model, truth, marker_positions(model, truth)


def turns_off_deg(model: ChainModel, a: ChainState, b: ChainState) -> Array:
    return np.degrees(np.delete(step_between(model, a, b), _ROOT_SHIFT, axis=1))


def occluded(data: Path) -> list[Result]:
    """Measure errors with occluded markers, in two runs.

    In the first run, each segment lacks one marker in a frame with a probability of 0.5. In the
    second run, 20 % of all markers are occluded at random.
    """
    model, truth, clean = exact(data)
    rng = np.random.default_rng(0)
    y = clean.copy()
    for t in range(len(y)):
        for s in range(len(model.segments)):
            if rng.random() < 0.5:
                y[t, rng.choice(np.flatnonzero(model.marker_segments == s))] = np.nan
    found = solve_frames(model, y)
    placed = marker_positions(model, found.state) - clean
    scattered = clean.copy()
    scattered[rng.random(scattered.shape[:2]) < 0.2] = np.nan
    loose = turns_off_deg(model, truth, solve_frames(model, scattered).state)
    return [
        Result("largest marker error", 1000 * float(np.abs(placed).max()), 1e-6, unit="mm"),
        Result(
            "largest orientation error",
            float(np.abs(turns_off_deg(model, truth, found.state)).max()),
            1e-6,
        ),
        Result(
            "a fifth of the markers occluded: orientation error",
            float(np.sqrt(np.mean(loose**2))),
            0.25,
        ),
    ]


def batch_us(model: ChainModel, y: Array) -> float:
    solve_frames(model, y)
    took = [cpu_s(lambda: solve_frames(model, y)) for _ in range(REPEATS)]
    return 1e6 * median(took) / len(y)


def live_us(model: ChainModel, y: Array) -> tuple[float, float]:
    """Return the median time per frame with covariance, and the tracking error, mm."""
    live = LiveInverseKinematics(model)
    residuals: list[Array] = []

    def feed(row: Array) -> None:
        residuals.append(live.feed(row).residuals)

    took = [cpu_s(partial(feed, row)) for row in y]
    return 1e6 * median(took), 1000 * tracking_error(np.array(residuals))


def speed(data: Path) -> list[Result]:
    """Measure the time per frame: seven segments (29 markers, 20 coordinates), and two segments."""
    model = oc4_lower(data)
    y = measured(data, "walking1", model)
    small = two_segments()
    _, swung = swing(small)
    took, error = live_us(model, y)
    full = 1000 * tracking_error(solve_frames(model, y).residuals)
    return [
        Result("seven segments, batch", batch_us(model, y), 400, unit="µs/frame"),
        Result("seven segments, frame by frame with covariance", took, 1200, unit="µs/frame"),
        Result("tracking error, ratio of frame by frame to batch", error / full, 1.001, unit=""),
        Result("two segments, batch", batch_us(small, swung), 50, unit="µs/frame"),
        Result(
            "two segments, frame by frame with covariance",
            live_us(small, swung)[0],
            300,
            unit="µs/frame",
        ),
    ]


_RECORDED = (FOLDER,)
EXPERIMENTS = (
    Experiment(
        "chain-jacobian",
        "Jacobian of the chain, compared with central differences",
        slope,
        LOWER_LIMBS,
        _RECORDED,
    ),
    Experiment(
        "chain-fit-recorded",
        "Inverse kinematics of seven segments before refinement, RMS marker error",
        fit,
        LOWER_LIMBS,
        _RECORDED,
    ),
    Experiment(
        "chain-occluded-markers",
        "Errors of inverse kinematics with occluded markers, without noise",
        occluded,
        LOWER_LIMBS,
        _RECORDED,
    ),
    Experiment(
        "inverse-kinematics-time",
        "CPU time of inverse kinematics",
        speed,
        LOWER_LIMBS,
        _RECORDED,
        timed=True,
    ),
)
