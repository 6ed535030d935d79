"""Regressors of the kernel model, from joint rotation, sensor disagreement and tilt.

Relative rotations do not change with a constant rotation of the world, and tilts do not change with
a rotation about the vertical. All regressors are therefore independent of the heading of the
subject. They vanish if the sensors agree, the joint is straight and the segment is upright. This is
approximately true in the static pose, in which the correction must be zero. The regression
therefore has no intercept.

.. math:: a_z(x) = e^{-|x - z|^2 / 2} - e^{-|x|^2 / 2} - e^{-|z|^2 / 2} + 1

is a *bump*: the Gaussian kernel between x and a center z, minus the terms that do not vanish at x =
0. It is the kernel of all functions f(x) - f(0) for which f has the Gaussian kernel.
"""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import difference_one

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion

PAIR_SHARE = 0.4
"""Ratio of the kernel width of sensor disagreement to the kernel width of joint rotation. It is
below 1, because soft tissue moves less than joints.
"""
TILTS = 3
"""Number of tilt components."""


def relative_rotations(sensors: Sequence[Array], mean: Array, q_other: Array) -> Array:
    r"""Return :math:`[k, d_2 \dots d_m]`, rad, shape (n, 3 m) for m sensors.

    :math:`k = \log(\bar q^* \otimes o)` is the joint rotation relative to the mean of the segment's
    sensors, and :math:`d_j = \log(x^* \otimes y_j)` the disagreement of the first sensor with each
    other sensor.

    Parameters
    ----------
    sensors : sequence of ndarray, shape (n, 4)
        Orientation of the segment computed from each of its sensors.
    mean : ndarray, shape (n, 4)
        Mean of the sensors.
    q_other : ndarray, shape (n, 4)
        Orientation of the neighboring segment.
    """
    inverse = rotation.conjugate(sensors[0])
    k = rotation.log(rotation.multiply(rotation.conjugate(mean), q_other))
    pairs = [rotation.log(rotation.multiply(inverse, q)) for q in sensors[1:]]
    return np.concatenate([k, *pairs], axis=1)


def relative_rotations_one(
    sensors: Sequence[Quaternion], mean: Quaternion, q_other: Quaternion
) -> list[float]:
    """Return the result of `relative_rotations` for one frame."""
    found = [*difference_one(mean, q_other)]
    for q in sensors[1:]:
        found += difference_one(sensors[0], q)
    return found


def tilts(q: Array) -> Array:
    """Return :math:`[v_1, v_2, 1 - v_3]` for the vertical v in segment axes, shape (n, 3).

    The tilt represents the proximal joint angle and the effect of gravity on soft tissue.
    """
    w, x, y, z = q.T
    found: Array = np.stack(
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 2.0 * (x * x + y * y)], axis=1
    )
    return found


def tilts_one(q: Quaternion) -> list[float]:
    """Return the result of `tilts` for one frame."""
    w, x, y, z = q
    return [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 2.0 * (x * x + y * y)]


def smooth_terms(u: Array) -> Array:
    r"""Return :math:`[1 - \cos f, \sin f, 1 - \cos 2f, \sin 2f, f k_2, f k_3, u]`, f = k_1.

    f is the rotation about x, the flexion axis. The soft-tissue artefact is assumed to be a smooth
    periodic function of flexion. The result has the shape (n, 6 + columns of u). u may contain
    tilts after the rotations.
    """
    f = u[:, :1]
    bends = [1.0 - np.cos(f), np.sin(f), 1.0 - np.cos(2.0 * f), np.sin(2.0 * f)]
    return np.concatenate([*bends, f * u[:, 1:3], u], axis=1)


def smooth_terms_one(u: Sequence[float]) -> list[float]:
    """Return the result of `smooth_terms` for one frame."""
    f = u[0]
    s, c = sin(f), cos(f)
    return [1.0 - c, s, 2.0 * s * s, 2.0 * s * c, f * u[1], f * u[2], *u]


def widths_of(width: float, sensors: int, *, tilted: bool) -> Array:
    """Return the kernel width of each rotation and tilt, rad, shape (3 m,) or (3 m + 3,)."""
    joint, pairs = [width] * 3, [PAIR_SHARE * width] * (3 * sensors - 3)
    return np.array(joint + pairs + [width] * (TILTS if tilted else 0))


def bumps(x: Array, centers: Array) -> Array:
    """Return a_z(x) for every row of x and every center z, shape (n, m)."""
    x2, z2 = 0.5 * np.sum(x**2, axis=1), 0.5 * np.sum(centers**2, axis=1)
    near = np.exp(x @ centers.T - x2[:, None] - z2)
    found: Array = near - np.exp(-x2)[:, None] - np.exp(-z2) + 1.0
    return found
