r"""What the anchored model looks at: joint rotation, disagreement of sensors, bumps of both.

Law: every feature is a function of body-frame relative rotations, so any constant turn of the world
cancels exactly, and every feature vanishes in the static pose, so a correction needs no intercept.

.. math:: a_z(x) = e^{-|x - z|^2 / 2} - e^{-|x|^2 / 2} - e^{-|z|^2 / 2} + 1

is the Gaussian kernel between x and a center z, less what would not vanish at x = 0: the kernel of
all functions f(x) - f(0) where f has the Gaussian kernel.
"""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import between_one, log_one

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.model import Quaternion

    Array = NDArray[np.float64]

JOINT_LENGTH = 0.5
"""Joint rotations this far apart have much to do with each other, rad."""
PAIR_LENGTH = 0.2
"""The same of the disagreement of sensors, rad."""
MOST_CENTERS = 24
NEAREST_CENTERS = 0.01
"""Centers nearer to each other than this (square root of it, in lengths) say the same."""


def relative_rotations(sensors: Sequence[Array], mean: Array, q_other: Array) -> Array:
    r"""Return :math:`[k, d_2 \dots d_m]`, rad, shape (n, 3 m) for m sensors.

    :math:`k = \log(\bar q^* \otimes o)` is the joint rotation seen by the mean of the segment's
    sensors and :math:`d_j = \log(x^* \otimes y_j)` the disagreement of the first with each other.

    Parameters
    ----------
    sensors : sequence of ndarray, shape (n, 4)
        Bone-aligned sensors of the segment.
    mean : ndarray, shape (n, 4)
        Their mean.
    q_other : ndarray, shape (n, 4)
        The neighbouring segment, bone-aligned.
    """
    inverse = rotation.conjugate(sensors[0])
    k = rotation.log(rotation.multiply(rotation.conjugate(mean), q_other))
    pairs = [rotation.log(rotation.multiply(inverse, q)) for q in sensors[1:]]
    return np.concatenate([k, *pairs], axis=1)


def relative_rotations_one(
    sensors: Sequence[Quaternion], mean: Quaternion, q_other: Quaternion
) -> list[float]:
    """Return the same of one frame."""
    found = [*log_one(between_one(mean, q_other))]
    for q in sensors[1:]:
        found += log_one(between_one(sensors[0], q))
    return found


def smooth_terms(u: Array) -> Array:
    r"""Return :math:`[u, 1 - \cos f, \sin f, 1 - \cos 2f, \sin 2f, f k_2, f k_3]`, f = k_1.

    f turns about x, the axis about which limbs flex: what skin does over a whole bend is a smooth
    periodic function of it. Shape (n, 3 m + 6).
    """
    f = u[:, :1]
    bends = [1.0 - np.cos(f), np.sin(f), 1.0 - np.cos(2.0 * f), np.sin(2.0 * f)]
    return np.concatenate([u, *bends, f * u[:, 1:3]], axis=1)


def smooth_terms_one(u: Sequence[float]) -> list[float]:
    """Return the same of one frame."""
    f = u[0]
    bends = (1.0 - cos(f), sin(f), 1.0 - cos(2.0 * f), sin(2.0 * f))
    return [*u, *bends, f * u[1], f * u[2]]


def lengths(width: int) -> Array:
    """Return what each of `width` relative rotations is measured by, rad, shape (width,)."""
    return np.array([JOINT_LENGTH] * 3 + [PAIR_LENGTH] * (width - 3))


def scaled_one(u: Sequence[float]) -> list[float]:
    """Return [x, |x|^2 / 2, 1] of one frame's relative rotations, x in units of `lengths`."""
    x = [u[0] / JOINT_LENGTH, u[1] / JOINT_LENGTH, u[2] / JOINT_LENGTH]
    x += [d / PAIR_LENGTH for d in u[3:]]
    return [*x, 0.5 * sum([c * c for c in x]), 1.0]


def spread_centers(x: Array) -> Array:
    """Return frames that lie far from each other and from the static pose, shape (m, width).

    Farthest-point choice, at most 24: each is the frame farthest from all before it.

    Parameters
    ----------
    x : ndarray, shape (n, width)
        Relative rotations in units of `lengths`.
    """
    distance = np.sum(x**2, axis=1)
    chosen: list[int] = []
    while len(chosen) < MOST_CENTERS:
        far = int(np.argmax(distance))
        if distance[far] < NEAREST_CENTERS:
            break
        chosen.append(far)
        distance = np.minimum(distance, np.sum((x - x[far]) ** 2, axis=1))
    return x[chosen]


def bumps(x: Array, centers: Array) -> Array:
    """Return a_z(x) for every row of x and every center z, shape (n, m)."""
    x2, z2 = 0.5 * np.sum(x**2, axis=1), 0.5 * np.sum(centers**2, axis=1)
    near = np.exp(x @ centers.T - x2[:, None] - z2)
    found: Array = near - np.exp(-x2)[:, None] - np.exp(-z2) + 1.0
    return found
