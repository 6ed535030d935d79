"""Weighted mean of several orientations of one segment.

The mean is the eigenvector mean of Markley et al. 2007. It does not depend on quaternion signs. If
the world is rotated, the mean rotates with it.
"""

from __future__ import annotations

from functools import cache
from math import copysign, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion, normalize_one

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion


def fuse(sensors: Sequence[Array], weights: Sequence[float]) -> Array:
    """Return the weighted mean orientation of every frame, shape (n, 4).

    Parameters
    ----------
    sensors : sequence of ndarray, shape (n, 4)
        One array for each sensor.
    weights : sequence of float
        Non-negative weight of each sensor.
    """
    if len(sensors) == 1:
        return rotation.normalize(sensors[0])
    if len(sensors) > 2:
        finite = np.isfinite(np.stack(sensors, axis=1)).all(axis=(1, 2))
        mean = np.full(sensors[0].shape, np.nan)
        stacked = np.stack([q[finite] for q in sensors], axis=1)
        mean[finite] = rotation.average(stacked, np.broadcast_to(weights, stacked.shape[:2]))
        return mean

    # For two sensors the closed form of `fuse_one` is evaluated for all frames.
    first, second = sensors
    w1, w2 = weights
    d = np.sum(first * second, axis=1)
    z = np.sqrt((w1 - w2) ** 2 + 4.0 * w1 * w2 * d * d)
    z = np.maximum(z, 1e-300)
    share = z * (w1 + w2 + z)
    a = np.sqrt(w1 * np.maximum(w1 - w2 + z, 0.0) / share)
    b = np.sqrt(w2 * np.maximum(w2 - w1 + z, 0.0) / share)
    return rotation.normalize(a[:, None] * first + np.copysign(b, d)[:, None] * second)


def fuse_one(sensors: Sequence[Quaternion], weights: Sequence[float]) -> Quaternion:
    r"""Return the weighted mean of one frame, in closed form for two sensors.

    .. math:: q = \sqrt{\tfrac{\omega_1(\omega_1 - \omega_2 + z)}{z(\omega_1 + \omega_2 + z)}} q_1
              + \mathrm{sign}(d) \sqrt{\tfrac{\omega_2(\omega_2 - \omega_1 + z)}
              {z(\omega_1 + \omega_2 + z)}} q_2,
              \quad z = \sqrt{(\omega_1 - \omega_2)^2 + 4 \omega_1 \omega_2 d^2}

    where d is the scalar product of the two quaternions (Markley et al. 2007, eq. 19). For more
    sensors the eigenvector is computed.
    """
    if len(sensors) == 1:
        return normalize_one(sensors[0])
    if len(sensors) > 2:
        return as_quaternion(rotation.average(np.array(sensors), np.array(weights)).tolist())

    (pw, px, py, pz), (qw, qx, qy, qz) = sensors
    w1, w2 = weights
    d = pw * qw + px * qx + py * qy + pz * qz
    if w1 == w2:  # then a = b
        if d < 0.0:
            return normalize_one((pw - qw, px - qx, py - qy, pz - qz))
        return normalize_one((pw + qw, px + qx, py + qy, pz + qz))

    z = max(sqrt((w1 - w2) ** 2 + 4.0 * w1 * w2 * d * d), 1e-300)
    share = z * (w1 + w2 + z)
    a = sqrt(w1 * max(w1 - w2 + z, 0.0) / share)
    b = copysign(sqrt(w2 * max(w2 - w1 + z, 0.0) / share), d)
    return normalize_one((a * pw + b * qw, a * px + b * qx, a * py + b * qy, a * pz + b * qz))


@cache
def equal_weights(count: int) -> tuple[float, ...]:
    """Return equal weights with sum 1."""
    return (1.0 / count,) * count
