"""Recursive least squares compared with batch least squares, and round trip of joint angles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.baselines.joint_angle_arrays import grood_suntay, patent_angles
from bench.baselines.recursive_least_squares import InformationForm, RecursiveLeastSquares
from bench.framework.experiment import Experiment, Result
from bench.framework.material import SEEDED
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from pathlib import Path


def recursive(_: Path) -> list[Result]:
    """Compare recursive and batch least squares: 15 regressors, 3 targets, forgetting 0.999."""
    rng = np.random.default_rng(15)
    n, p, forgetting, ridge = 500, 15, 0.999, 0.01
    g, noise = rng.normal(size=(n, p)), 0.1 * rng.normal(size=(n, 3))
    y, weights = g @ rng.normal(size=(p, 3)) + noise, rng.uniform(0.2, 1.0, n)
    stepwise = RecursiveLeastSquares(p, 3, ridge, forgetting)
    information = InformationForm(p, 3, ridge, forgetting)
    for i in range(n):
        stepwise.feed(g[i], y[i], float(weights[i]))
        information.feed(g[i], y[i], float(weights[i]))
    decay = weights * forgetting ** np.arange(n - 1, -1, -1)
    gram = (g * decay[:, None]).T @ g + ridge * forgetting**n * np.eye(p)
    batch = np.linalg.solve(gram, (g * decay[:, None]).T @ y)
    return [
        Result(
            "recursive least squares",
            float(np.abs(stepwise.coefficients - batch).max()),
            1e-9,
            unit="",
        ),
        Result(
            "information form", float(np.abs(information.coefficients - batch).max()), 1e-9, unit=""
        ),
    ]


def round_trip(_: Path) -> list[Result]:
    """Convert 20 000 random rotations to angles, and back by elementary rotations."""
    q = rotation.normalize(np.random.default_rng(16).normal(size=(20_000, 4)))
    x, y, z = np.eye(3)
    alpha = patent_angles(q)
    phi = grood_suntay(q)
    figures = []
    for label, found, order in (
        ("patent", alpha, ((2, z), (1, y), (0, x))),
        ("Grood and Suntay", phi, ((0, x), (1, y), (2, z))),
    ):
        back = rotation.IDENTITY
        for column, axis in order:
            turn = rotation.exp(found.angles[:, column, None] * axis)
            back = rotation.multiply(back, turn)
        off = rotation.angle_between(back, q)[~found.gimbal].max()
        figures.append(Result(label, float(np.rad2deg(off)), 1e-9))
    return figures


EXPERIMENTS = (
    Experiment(
        "recursive-fit-equivalence",
        "Largest difference between recursive regression and the batch solution",
        recursive,
        SEEDED,
    ),
    Experiment(
        "joint-angle-round-trip",
        "Largest error after the conversion of 20 000 random rotations to joint angles and back",
        round_trip,
        SEEDED,
    ),
)
