"""Joint angles of many frames at once, the reference for the daemon's angles of single frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.joint_angles import GIMBAL_SINE

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.arrays import Array

_DOWN = np.array([0.0, 0.0, -1.0])


class AngleSequence(NamedTuple):
    """Three angles of a rotation sequence."""

    angles: Array
    """Joint angles, rad, shape (..., 3)."""
    gimbal: NDArray[np.bool_]
    """Whether the frame is in gimbal lock, where only the sum or the difference of the first and
    the last angle is determined; shape (...)."""


def patent_angles(q_joint: ArrayLike) -> AngleSequence:
    r"""Return the patent's angles (alpha, beta, gamma) of R = Rz(gamma) Ry(beta) Rx(alpha).

    R is the matrix of `q_joint` = (q_0, q_1, q_2, q_3), scalar first.

    .. math:: \alpha = \mathrm{atan2}(2(q_0 q_1 + q_2 q_3), 1 - 2(q_1^2 + q_2^2)),\;
              \beta = \arcsin 2(q_0 q_2 - q_3 q_1),\;
              \gamma = \mathrm{atan2}(2(q_0 q_3 + q_1 q_2), 1 - 2(q_2^2 + q_3^2))

    The daemon uses ``read_patent``, which computes the same angles for one frame.
    """
    w, x, y, z = np.moveaxis(np.asarray(q_joint, dtype=np.float64), -1, 0)
    alpha = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    gamma = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return _sequence(alpha, 2 * (w * y - z * x), gamma, locked=2 * np.arctan2(x, w))


def grood_suntay(q_joint: ArrayLike) -> AngleSequence:
    r"""Return (phi, theta, psi) of R = Rx(phi) Ry(theta) Rz(psi), the matrix of `q_joint`.

    .. math:: \phi = \mathrm{atan2}(-R_{12}, R_{22}),\; \theta = \arcsin R_{02},\;
              \psi = \mathrm{atan2}(-R_{01}, R_{00})

    Source: Grood and Suntay 1983, doi 10.1115/1.3138397, in the axes of this project. Signs do not
    depend on the side.
    """
    w, x, y, z = np.moveaxis(np.asarray(q_joint, dtype=np.float64), -1, 0)
    phi = np.arctan2(2 * (w * x - y * z), 1 - 2 * (x * x + y * y))
    psi = np.arctan2(2 * (w * z - x * y), 1 - 2 * (y * y + z * z))
    return _sequence(phi, 2 * (x * z + w * y), psi, locked=2 * np.arctan2(x, w))


def _sequence(first: Array, sine: Array, last: Array, *, locked: Array) -> AngleSequence:
    gimbal = np.abs(sine) > GIMBAL_SINE
    first = np.where(gimbal, _wrapped(locked), first)
    last = np.where(gimbal, 0.0, last)
    middle = np.arcsin(np.clip(sine, -1.0, 1.0))  # rounding can yield 1 + 1e-16, and then NaN
    return AngleSequence(np.stack((first, middle, last), axis=-1), gimbal)


def anatomical(angles: ArrayLike, *, flexion_sign: float, left: bool) -> Array:
    """Return (flexion, adduction, internal rotation), rad, from ``grood_suntay`` angles.

    Parameters
    ----------
    angles : array_like, shape (..., 3)
        Angles phi, theta and psi, rad.
    flexion_sign : float
        +1 for hip and ankle, -1 for the knee, whose flexion moves the heel back.
    left : bool
        Whether the limb is a left limb. Adduction and rotation then change sign, so both sides
        agree.
    """
    side = -1.0 if left else 1.0
    return np.multiply(np.asarray(angles, dtype=np.float64), [flexion_sign, side, side])


def included_angle(q_joint: ArrayLike) -> Array:
    """Return the angle between the two bone axes, rad in [0, pi], shape (...); 0 when straight.

    The angle does not depend on the choice of the flexion axis. The inner angle of the joint is pi
    minus this angle.
    """
    turned = rotation.rotate(q_joint, _DOWN)
    sine = np.hypot(turned[..., 0], turned[..., 1])
    angle: Array = np.arctan2(sine, -turned[..., 2])
    return angle


def _wrapped(angle: Array) -> Array:
    """Return the angle in (-pi, pi]."""
    wrapped: Array = np.pi - np.mod(np.pi - angle, 2.0 * np.pi)
    return wrapped
