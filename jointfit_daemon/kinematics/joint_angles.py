r"""Joint angles from the rotation between two segments.

.. math:: q_j = q_{proximal}^* \otimes q_{distal}

R is the matrix of this quaternion; its indices start at 0. CONVENTIONS.md defines segment axes (x
to the right, y anterior, z proximal) and signs. Angles are in rad. q and -q have the same angles.
`AngleConvention` selects the three angles of a joint. If two axes of a sequence coincide, the
angles about these axes are not unique. One of them is then set to 0, the other contains the whole
rotation, and the frame is flagged as gimbal-locked.
"""

from __future__ import annotations

from math import asin, atan2, hypot, inf, pi, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import between_one
from jointfit_daemon.model import AngleConvention, JointAngles

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion

GIMBAL_SINE = 0.9999
"""Sine of the middle angle above which the two outer angles are not separated."""
LOCKED_SINE = sqrt(1.0 - GIMBAL_SINE**2)
"""Sine of the elevation (0.8°) below which the plane of elevation and the axial rotation are not
separated.
"""
_SMALL_TILT = 1e-6
"""Sine of half the tilt below which the tilt is computed as twice this sine."""


def joint_rotation(q_proximal: ArrayLike, q_distal: ArrayLike) -> Array:
    """Return q_proximal_distal, shape (..., 4), from two segments in one world."""
    return rotation.multiply(rotation.conjugate(q_proximal), q_distal)


def swing_twist(q_joint: ArrayLike, axis: ArrayLike) -> tuple[Array, Array]:
    r"""Split a rotation into a twist about `axis` and a swing about an axis normal to `axis`.

    .. math:: \mathrm{twist} = 2\,\mathrm{atan2}(q_v \cdot a, q_0), \qquad
              \mathrm{swing} = q_j \otimes \mathrm{twist}^*

    Parameters
    ----------
    q_joint : array_like, shape (..., 4)
        Rotation q_proximal_distal.
    axis : array_like, shape (3,)
        Unit vector in the distal frame.

    Returns
    -------
    swing : ndarray, shape (..., 4)
    twist : ndarray, shape (...)
        Twist angle, rad in (-pi, pi].
    """
    q = np.asarray(q_joint, dtype=np.float64)
    a = np.asarray(axis, dtype=np.float64)
    turned = 2.0 * np.arctan2(q[..., 1:] @ a, q[..., 0])
    twist: Array = np.pi - np.mod(np.pi - turned, 2.0 * np.pi)
    return rotation.multiply(q, rotation.exp(-twist[..., None] * a)), twist


def functional_axis(q_joint: ArrayLike) -> Array:
    """Return the principal rotation axis of a joint as a unit vector, shape (3,).

    The axis is the first right singular vector of the rotation vectors of `q_joint`, shape (n, 4).
    Its sign is selected so that the x component is not negative.
    """
    axis: Array = np.linalg.svd(rotation.log(q_joint), full_matrices=False)[2][0]
    return -axis if axis[0] < 0.0 else axis


class JointReading(NamedTuple):
    """Angles of one joint in one frame."""

    angles: JointAngles
    inner: float
    """Angle between the segments, rad; pi when straight."""
    gimbal: bool
    sd_factor: float
    """Ratio of the standard deviation of the main angle to the standard deviation of the rotation
    per axis.

    The main angle is elevation in the convention ``elevation``, otherwise flexion. The ratio is
    infinite where the main angle is not defined.
    """


def read_joint(
    q_proximal: Quaternion,
    q_distal: Quaternion,
    *,
    flexion_sign: float,
    left: bool,
    convention: AngleConvention = AngleConvention.FLEXION,
) -> JointReading:
    r"""Return the angles of a convention, and the inner angle, from two plain tuples.

    .. math:: \text{flexion: } R = R_x(\phi) R_y(\theta) R_z(\psi): \quad
              \phi = \mathrm{atan2}(-R_{12}, R_{22}),\; \theta = \arcsin R_{02},\;
              \psi = \mathrm{atan2}(-R_{01}, R_{00})

    ``_elevation``, ``_tilt_torsion`` and ``_trunk`` define the other conventions. The inner angle
    is the same in all conventions.

    Source: Grood and Suntay 1983, doi 10.1115/1.3138397, in the axes of CONVENTIONS.md; Wu et al.
    2002, doi 10.1016/S0021-9290(01)00222-6, and 2005, doi 10.1016/j.jbiomech.2004.05.042.

    Parameters
    ----------
    q_proximal, q_distal : Quaternion
        Segments in one world.
    flexion_sign : float
        +1 for hip and ankle, -1 for the knee, where flexion moves the heel back.
    left : bool
        Whether the limb is a left limb. The angles of a left limb are mirrored at the sagittal
        plane, so that equal movements of both sides have equal angles. The trunk does not use this
        parameter.
    convention : AngleConvention
        Definition of the three angles.
    """
    if convention is AngleConvention.TRUNK:
        return _trunk(between_one(q_distal, q_proximal))
    w, x, y, z = between_one(q_proximal, q_distal)
    if left:
        y, z = -y, -z
    if convention is AngleConvention.ELEVATION:
        return _elevation(w, x, y, z)
    if convention is AngleConvention.TILT_TORSION:
        return _tilt_torsion(w, x, y, z, flexion_sign)
    return _flexion(w, x, y, z, flexion_sign)


def _flexion(w: float, x: float, y: float, z: float, sign: float) -> JointReading:
    r02 = 2.0 * (x * z + w * y)
    minus_r12 = 2.0 * (w * x - y * z)
    r22 = 1.0 - 2.0 * (x * x + y * y)

    gimbal = abs(r02) > GIMBAL_SINE
    if gimbal:
        phi, psi = _wrap_one(2.0 * atan2(x, w)), 0.0
    else:
        phi = atan2(minus_r12, r22)
        psi = atan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (y * y + z * z))
    theta = asin(min(max(r02, -1.0), 1.0))

    cosine = hypot(minus_r12, r22)
    inner = pi - atan2(hypot(r02, minus_r12), r22)
    angles = JointAngles(sign * phi, theta, psi)
    return JointReading(angles, inner, gimbal, inf if gimbal else 1.0 / cosine)


def _trunk(q_lower_upper: Quaternion) -> JointReading:
    """Return forward flexion, bending to the right and rotation to the left of the upper segment.

    The sequence of rotations is the sequence of the convention ``flexion``, for the upper segment
    relative to the lower segment. In a chain the upper segment is the proximal segment.
    """
    return _flexion(*q_lower_upper, -1.0)


def _elevation(w: float, x: float, y: float, z: float) -> JointReading:
    r"""Return plane of elevation, elevation and axial rotation (Y-X-Y in ISB axes).

    .. math:: R = R_z(\gamma) R_y(-\epsilon) R_z(\psi), \quad
              \epsilon = 2\,\mathrm{atan2}(\sqrt{x^2 + y^2}, \sqrt{w^2 + z^2}), \quad
              \gamma, \psi = \mathrm{atan2}(z, w) \pm \mathrm{atan2}(x, -y)

    γ is the plane, ε the elevation, ψ the axial rotation. The plane is 0 in abduction and 90
    degrees in forward flexion. If the elevation is 0 or 180 degrees, plane and axial rotation are
    not separable, and the plane is 0.
    """
    swing, twist = hypot(x, y), hypot(w, z)
    elevation = 2.0 * atan2(swing, twist)
    half_sum, half_difference = atan2(z, w), atan2(x, -y)

    gimbal = 2.0 * swing * twist < LOCKED_SINE
    if gimbal:
        plane, rotated = 0.0, 2.0 * (half_sum if twist > swing else -half_difference)
    else:
        plane, rotated = _wrap_one(half_sum + half_difference), half_sum - half_difference
    angles = JointAngles(plane, elevation, _wrap_one(rotated))
    return JointReading(angles, pi - elevation, gimbal, 1.0)


def _tilt_torsion(w: float, x: float, y: float, z: float, sign: float) -> JointReading:
    r"""Return the tilt of the long axis as flexion and adduction, and the torsion about this axis.

    .. math:: R = \exp(v_x, v_y, 0)\, R_z(\tau), \quad \tau = 2\,\mathrm{atan2}(z, w)

    The tilt :math:`|v|` equals the elevation of the convention ``elevation``, and the direction of
    v is the plane of elevation. In a sagittal or frontal movement, :math:`v` is the flexion or
    adduction of the convention ``flexion``. Only a tilt of 180 degrees is singular.

    A rotation error perpendicular to the tilt is magnified by :math:`|v| / \sin|v|`.
    """
    swing, twist = hypot(x, y), hypot(w, z)
    tilt = 2.0 * atan2(swing, twist)
    scale = tilt / swing if swing > _SMALL_TILT else 2.0

    gimbal = twist < swing and 2.0 * swing * twist < LOCKED_SINE
    c, s = (1.0, 0.0) if gimbal else (w / twist, z / twist)
    v_x, v_y = scale * (x * c - y * s), scale * (x * s + y * c)
    torsion = 0.0 if gimbal else _wrap_one(2.0 * atan2(z, w))
    angles = JointAngles(sign * v_x, v_y, torsion)
    if gimbal or swing <= _SMALL_TILT:
        return JointReading(angles, pi - tilt, gimbal, inf if gimbal else 1.0)

    across = tilt / (2.0 * swing * twist)
    return JointReading(angles, pi - tilt, gimbal, hypot(v_x, across * v_y) / tilt)


class PatentReading(NamedTuple):
    """Joint angles of the patent in one frame, as returned by ``read_patent``."""

    alpha: float
    """Rotation about x, rad."""
    beta: float
    """Rotation about y, rad."""
    gamma: float
    """Rotation about z, rad; 0 in gimbal lock."""
    joint: float
    """Joint angle of the patent, pi - abs(alpha), rad."""
    gimbal: bool
    """Whether the frame is gimbal-locked. Beta is then close to 90 or -90 degrees, and alpha
    contains the whole rotation about the axes of alpha and gamma, which coincide.
    """


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
        alpha, gamma = _wrap_one(2.0 * atan2(x, w)), 0.0
    else:
        alpha = atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        gamma = atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    beta = asin(min(max(sine, -1.0), 1.0))
    return PatentReading(alpha, beta, gamma, pi - abs(alpha), gimbal)


def _wrap_one(angle: float) -> float:
    return pi - (pi - angle) % (2.0 * pi)
