r"""What a soft-tissue correction may look at: rotations between sensors, and nothing else.

Law: every feature is a body-frame relative rotation, so any constant turn of the world cancels
exactly, and every feature vanishes in the static pose, so a correction needs no intercept there.
"""

from __future__ import annotations

from math import sin
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import between_one, log_one

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion


def features(sensors: Sequence[Array], q_other: Array) -> Array:
    r"""Return the regressors of a segment, shape (n, 12 + 3 (m - 1)) for m sensors.

    .. math:: \varphi = [k,\ d_2 \dots d_m,\ |k| \circ k,\ k_1 k_2,\ k_1 k_3,\ k_2 k_3,\ \sin 2k]

    with :math:`k = \log(x^* \otimes o)` the joint rotation seen by the first sensor and
    :math:`d_j = \log(x^* \otimes y_j)` its disagreement with each further one, all rad.

    Parameters
    ----------
    sensors : sequence of ndarray, shape (n, 4)
        Bone-aligned sensors of the segment.
    q_other : ndarray, shape (n, 4)
        Bone-aligned sensor of the neighbouring segment.
    """
    inverse = rotation.conjugate(sensors[0])
    k = rotation.log(rotation.multiply(inverse, q_other))
    pairs = [rotation.log(rotation.multiply(inverse, q)) for q in sensors[1:]]
    products = k[:, [0, 0, 1]] * k[:, [1, 2, 2]]
    return np.concatenate([k, *pairs, np.abs(k) * k, products, np.sin(2.0 * k)], axis=1)


def features_one(sensors: Sequence[Quaternion], q_other: Quaternion) -> list[float]:
    """Return the same of one frame."""
    first = sensors[0]
    a, b, c = log_one(between_one(first, q_other))
    found = [a, b, c]
    for q in sensors[1:]:
        found += log_one(between_one(first, q))
    found += (abs(a) * a, abs(b) * b, abs(c) * c, a * b, a * c, b * c)
    found += (sin(2.0 * a), sin(2.0 * b), sin(2.0 * c))
    return found
