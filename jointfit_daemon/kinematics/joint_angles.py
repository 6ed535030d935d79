r"""Joint angles from the rotation between two segments.

.. math:: q_j = q_{proximal}^* \otimes q_{distal}

with matrix R, indices from 0. Segment axes and signs are those of CONVENTIONS.md (x to the right, y
anterior, z proximal); angles in rad; q and -q give the same result. Where the middle angle of a
sequence reaches 90 degrees, the outer two rotate about one line. The last one is then 0, the first
one contains the whole rotation, and the frame is flagged as gimbal-locked.
"""

from __future__ import annotations

from math import asin, atan2, hypot, pi
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import between_one
from jointfit_daemon.model import JointAngles

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion

GIMBAL_SINE = 0.9999
"""Sine of the middle angle above which the outer two are not separated."""


def joint_rotation(q_proximal: ArrayLike, q_distal: ArrayLike) -> Array:
    """Return q_proximal_distal, shape (..., 4), from two segments in one world."""
    return rotation.multiply(rotation.conjugate(q_proximal), q_distal)


def swing_twist(q_joint: ArrayLike, axis: ArrayLike) -> tuple[Array, Array]:
    r"""Split a rotation: first a twist about `axis` of the distal frame, then a swing normal to it.

    .. math:: \mathrm{twist} = 2\,\mathrm{atan2}(q_v \cdot a, q_0), \qquad
              \mathrm{swing} = q_j \otimes \mathrm{twist}^*

    Parameters
    ----------
    q_joint : array_like, shape (..., 4)
    axis : array_like, shape (3,)
        Unit vector.

    Returns
    -------
    swing : ndarray, shape (..., 4)
    twist : ndarray, shape (...)
        rad in (-pi, pi].
    """
    q = np.asarray(q_joint, dtype=np.float64)
    a = np.asarray(axis, dtype=np.float64)
    turned = 2.0 * np.arctan2(q[..., 1:] @ a, q[..., 0])
    twist: Array = np.pi - np.mod(np.pi - turned, 2.0 * np.pi)
    return rotation.multiply(q, rotation.exp(-twist[..., None] * a)), twist


def functional_axis(q_joint: ArrayLike) -> Array:
    """Return the principal rotation axis of a joint: unit, shape (3,), pointing to the right.

    First right singular vector of the joint's rotation vectors; input shape (n, 4).
    """
    axis: Array = np.linalg.svd(rotation.log(q_joint), full_matrices=False)[2][0]
    return -axis if axis[0] < 0.0 else axis


class JointReading(NamedTuple):
    """The angles of one joint in one frame."""

    angles: JointAngles
    inner: float
    """Angle between the segments, rad: pi when straight."""
    gimbal: bool


def read_joint(
    q_proximal: Quaternion, q_distal: Quaternion, *, flexion_sign: float, left: bool
) -> JointReading:
    r"""Return anatomical and inner angle of one frame of plain tuples.

    .. math:: R = R_x(\phi) R_y(\theta) R_z(\psi): \quad
              \phi = \mathrm{atan2}(-R_{12}, R_{22}),\; \theta = \arcsin R_{02},\;
              \psi = \mathrm{atan2}(-R_{01}, R_{00})

    Source: Grood and Suntay 1983, doi 10.1115/1.3138397, in the axes of CONVENTIONS.md. The inner
    angle does not depend on the choice of the flexion axis.

    Parameters
    ----------
    q_proximal, q_distal : Quaternion
        Segments in one world.
    flexion_sign : float
        +1 for hip and ankle, -1 for the knee, where flexion moves the heel back.
    left : bool
        Left limb: adduction and rotation change sign, so that both sides agree.
    """
    w, x, y, z = between_one(q_proximal, q_distal)
    r02 = 2.0 * (x * z + w * y)
    minus_r12 = 2.0 * (w * x - y * z)
    r22 = 1.0 - 2.0 * (x * x + y * y)

    gimbal = abs(r02) > GIMBAL_SINE
    if gimbal:
        phi, psi = _wrapped_one(2.0 * atan2(x, w)), 0.0
    else:
        phi = atan2(minus_r12, r22)
        psi = atan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (y * y + z * z))
    theta = asin(min(max(r02, -1.0), 1.0))

    side = -1.0 if left else 1.0
    angles = JointAngles(flexion_sign * phi, side * theta, side * psi)
    return JointReading(angles, pi - atan2(hypot(r02, minus_r12), r22), gimbal)


class PatentReading(NamedTuple):
    """Joint angles of the patent in one frame; see ``read_patent``."""

    alpha: float
    """Rotation about x, rad."""
    beta: float
    """Rotation about y, rad."""
    gamma: float
    """Angle about z, rad; 0 in gimbal lock."""
    joint: float
    """pi - abs(alpha), rad: the patent's joint angle."""
    gimbal: bool
    """Whether beta is close to 90 degrees, so that alpha contains the whole rotation."""


def read_patent(q_proximal: Quaternion, q_distal: Quaternion) -> PatentReading:
    r"""Return the patent's angles of one frame, R = Rz(gamma) Ry(beta) Rx(alpha).

    .. math:: \alpha = \mathrm{atan2}(2(q_0 q_1 + q_2 q_3), 1 - 2(q_1^2 + q_2^2)),\;
              \beta = \arcsin 2(q_0 q_2 - q_3 q_1),\;
              \gamma = \mathrm{atan2}(2(q_0 q_3 + q_1 q_2), 1 - 2(q_2^2 + q_3^2))

    The joint angle of the patent is pi - abs(alpha), which equals the inner angle only for pure
    flexion about x.
    """
    w, x, y, z = between_one(q_proximal, q_distal)
    sine = 2.0 * (w * y - z * x)

    gimbal = abs(sine) > GIMBAL_SINE
    if gimbal:
        alpha, gamma = _wrapped_one(2.0 * atan2(x, w)), 0.0
    else:
        alpha = atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        gamma = atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    beta = asin(min(max(sine, -1.0), 1.0))
    return PatentReading(alpha, beta, gamma, pi - abs(alpha), gimbal)


def _wrapped_one(angle: float) -> float:
    return pi - (pi - angle) % (2.0 * pi)
