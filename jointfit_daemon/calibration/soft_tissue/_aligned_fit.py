"""Fit of the aligned mean, which contains two alignments and a weight for each sensor.

The alignments are the rotation of the sensor's world and the sensor-to-segment alignment.
"""

from __future__ import annotations

from jointfit_daemon.calibration.registration import fit_sensor_alignment
from jointfit_daemon.calibration.soft_tissue._mean_fit import fusion_weights
from jointfit_daemon.calibration.soft_tissue._segment_training import (
    SegmentTraining,
    held_out_sd,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import AlignedModel


def fit_aligned(training: SegmentTraining) -> AlignedModel:
    """Return the mean of aligned sensors, weighted by their residual errors.

    Each sensor is aligned by a robot-world and hand-eye calibration with known verticals
    (`fit_sensor_alignment`). The mean is the eigenvector mean of Markley et al. 2007.
    """
    sd = held_out_sd(training, lambda part, test: _fit_model(part, 0.0).predict(test.sensors))
    return _fit_model(training, sd)


def _fit_model(training: SegmentTraining, sd: float) -> AlignedModel:
    # Each sensor is aligned first. The errors of the aligned sensors then determine the weights.
    found = [fit_sensor_alignment("heading", q, training.q_reference) for q in training.sensors]
    turned = [
        rotation.multiply(rotation.multiply(one.q_world, q), one.q_mount)
        for one, q in zip(found, training.sensors, strict=True)
    ]
    return AlignedModel(
        tuple(as_quaternion(one.q_world.tolist()) for one in found),
        tuple(as_quaternion(one.q_mount.tolist()) for one in found),
        tuple(fusion_weights(turned, training.q_reference).tolist()),
        sd,
        training.movements,
    )
