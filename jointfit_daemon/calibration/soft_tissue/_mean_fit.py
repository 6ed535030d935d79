"""Fits of the weighted mean: equal weights, only the best sensor, or weights from the errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.soft_tissue._segment_training import (
    SegmentTraining,
    held_out_sd,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import MeanModel, equal_weights, fuse

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array

_SMALLEST_VARIANCE = 1e-12
"""Lower bound of an error variance, rad², so that a sensor equal to the reference has a finite
weight.
"""


def fusion_weights(sensors: Sequence[Array], q_reference: Array) -> Array:
    """Return weights 1 / mean(e²), normalized to sum 1, where e is the angle to the reference.

    Parameters
    ----------
    sensors : sequence of ndarray, shape (n, 4)
        Bone-aligned orientations, one array for each sensor.
    q_reference : ndarray, shape (n, 4)

    Returns
    -------
    ndarray, shape (len(sensors),)
    """
    variances = [np.mean(rotation.angle_between(q, q_reference) ** 2) for q in sensors]
    weights = 1.0 / np.maximum(np.array(variances), _SMALLEST_VARIANCE)
    normalized: Array = weights / weights.sum()
    return normalized


def plain_mean(training: SegmentTraining) -> MeanModel:
    """Return the mean with equal weights and its RMS error in training, as a baseline."""
    weights = equal_weights(len(training.sensors))
    mean = fuse(training.sensors, weights)
    angles = rotation.angle_between(mean, training.q_reference)
    return MeanModel(weights, float(np.sqrt(np.mean(angles**2) / 3.0)))


def best_single(training: SegmentTraining) -> MeanModel:
    """Return the model that uses only the sensor with the smallest training error."""

    def best(part: SegmentTraining) -> int:
        errors = [rotation.angle_between(q, part.q_reference) for q in part.sensors]
        return int(np.argmin([np.mean(error**2) for error in errors]))

    chosen = best(training)
    weights = tuple(float(k == chosen) for k in range(len(training.sensors)))
    sd = held_out_sd(training, lambda part, test: test.sensors[best(part)])
    return MeanModel(weights, sd)


def fit_mean(training: SegmentTraining) -> MeanModel:
    """Return the mean weighted by the error of each sensor relative to the reference."""

    def weights(part: SegmentTraining) -> tuple[float, ...]:
        return tuple(fusion_weights(part.sensors, part.q_reference).tolist())

    sd = held_out_sd(training, lambda part, test: fuse(test.sensors, weights(part)))
    return MeanModel(weights(training), sd)
