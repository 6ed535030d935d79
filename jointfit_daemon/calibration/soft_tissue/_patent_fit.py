"""Fits of the regression of the patent, in two interpretations of the patent text."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.soft_tissue._segment_training import (
    SegmentTraining,
    held_out_sd,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import PatentModel, PatentReading

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array


def fit_patent(reading: PatentReading, training: SegmentTraining) -> PatentModel:
    """Return the regression of one interpretation, with its error on held-out blocks.

    The least-squares problem is solved by orthogonal decomposition. Normal equations would square
    the condition numbers, which are close to a thousand.
    """
    sd = held_out_sd(
        training, lambda part, test: _fit_regression(reading, part, 0.0).predict(test.sensors)
    )
    return _fit_regression(reading, training, sd)


def _fit_regression(reading: PatentReading, training: SegmentTraining, sd: float) -> PatentModel:
    q_sign = training.q_reference[0]
    inputs = [rotation.align_hemisphere(q, q_sign) for q in training.sensors]
    target = rotation.align_hemisphere(training.q_reference, q_sign)
    table = (_solve_separately if reading == "patent12" else _solve_shared)(inputs, target)
    rows = tuple(tuple(row) for row in table.tolist())
    return PatentModel(reading, rows, as_quaternion(q_sign.tolist()), sd, training.movements)


def _solve_separately(inputs: list[Array], target: Array) -> Array:
    """Fit four separate systems, one per component, with len(inputs) + 1 parameters each."""
    rows = []
    for k in range(4):
        A = np.column_stack([*(q[:, k] for q in inputs), np.ones(len(target))])
        rows.append(np.linalg.lstsq(A, target[:, k], rcond=None)[0])
    return np.array(rows)


def _solve_shared(inputs: list[Array], target: Array) -> Array:
    """Fit all components together; each sensor has one coefficient, each component an intercept."""
    n, count = len(target), len(inputs)
    A = np.zeros((4 * n, count + 4))
    for m, q in enumerate(inputs):
        A[:, m] = q.T.reshape(-1)
    for k in range(4):
        A[k * n : (k + 1) * n, count + k] = 1.0
    solved = np.linalg.lstsq(A, target.T.reshape(-1), rcond=None)[0]
    return np.column_stack([np.tile(solved[:count], (4, 1)), solved[count:]])
