"""Unit quaternions as plain tuples, for code that runs once per sample or frame.

Conventions and formulas are the same as in ``rotation``. The overhead of one NumPy call, about a
microsecond, exceeds the time of a whole product of plain floats.
"""

from __future__ import annotations

from math import atan2, cos, sin, sqrt
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from jointfit_daemon.model import Quaternion, Vector

IDENTITY_ONE: Quaternion = (1.0, 0.0, 0.0, 0.0)

_SMALL_ANGLE = 1e-6
_SMALL_SINE = 1e-9


def multiply_one(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the Hamilton product p q."""
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


def conjugate_one(q: Quaternion) -> Quaternion:
    """Return the inverse of a unit quaternion."""
    return (q[0], -q[1], -q[2], -q[3])


def between_one(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return a* b, the orientation of b relative to a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw + ax * bx + ay * by + az * bz,
        aw * bx - ax * bw - ay * bz + az * by,
        aw * by + ax * bz - ay * bw - az * bx,
        aw * bz - ax * by + ay * bx - az * bw,
    )


def rotate_one(q: Quaternion, v: Vector) -> Vector:
    """Rotate `v` from b- to a-coordinates by ``q_a_b``."""
    w, x, y, z = q
    vx, vy, vz = v
    tx = 2.0 * (y * vz - z * vy)
    ty = 2.0 * (z * vx - x * vz)
    tz = 2.0 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


def rotate_z_one(q: Quaternion, length: float) -> Vector:
    """Return ``rotate_one(q, (0, 0, length))`` at lower cost."""
    w, x, y, z = q
    tx, ty = 2.0 * (y * length), -2.0 * (x * length)
    return (w * tx - z * ty, w * ty + z * tx, length + x * ty - y * tx)


def exp_one(r: Vector) -> Quaternion:
    """Return the quaternion of a rotation vector, rad."""
    x, y, z = r
    angle = sqrt(x * x + y * y + z * z)
    scale = 0.5 - angle * angle / 48.0 if angle < _SMALL_ANGLE else sin(0.5 * angle) / angle
    return (cos(0.5 * angle), scale * x, scale * y, scale * z)


def log_one(q: Quaternion) -> Vector:
    """Return the shortest rotation vector, rad; its length is at most pi."""
    w, x, y, z = q
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < _SMALL_SINE else 2.0 * atan2(sine, w) / sine
    return (scale * x, scale * y, scale * z)


def difference_one(a: Quaternion, b: Quaternion) -> Vector:
    """Return ``log_one(between_one(a, b))``, the rotation vector from a to b, rad, in one call."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    w = aw * bw + ax * bx + ay * by + az * bz
    x = aw * bx - ax * bw - ay * bz + az * by
    y = aw * by + ax * bz - ay * bw - az * bx
    z = aw * bz - ax * by + ay * bx - az * bw
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < _SMALL_SINE else 2.0 * atan2(sine, w) / sine
    return (scale * x, scale * y, scale * z)


def perturb_one(q: Quaternion, r: Vector) -> Quaternion:
    """Return ``multiply_one(q, exp_one(r))``, q rotated by r in its own frame, in one call."""
    pw, px, py, pz = q
    x, y, z = r
    angle = sqrt(x * x + y * y + z * z)
    scale = 0.5 - angle * angle / 48.0 if angle < _SMALL_ANGLE else sin(0.5 * angle) / angle
    w, x, y, z = cos(0.5 * angle), scale * x, scale * y, scale * z
    return (
        pw * w - px * x - py * y - pz * z,
        pw * x + px * w + py * z - pz * y,
        pw * y - px * z + py * w + pz * x,
        pw * z + px * y - py * x + pz * w,
    )


def angle_between_one(a: Quaternion, b: Quaternion) -> float:
    """Return the angle of the rotation from a to b, rad in [0, pi]."""
    w, x, y, z = between_one(a, b)
    return 2.0 * atan2(sqrt(x * x + y * y + z * z), abs(w))


def normalize_one(q: Sequence[float]) -> Quaternion:
    """Return q / |q|.

    Raises
    ------
    ZeroDivisionError
        `q` is zero.
    """
    w, x, y, z = q
    scale = 1.0 / sqrt(w * w + x * x + y * y + z * z)
    return (w * scale, x * scale, y * scale, z * scale)


def interpolate_one(q0: Quaternion, q1: Quaternion, a: float) -> Quaternion:
    """Return the rotation at fraction `a` from q0 to q1."""
    x, y, z = difference_one(q0, q1)
    return perturb_one(q0, (a * x, a * y, a * z))


def as_quaternion(q: Iterable[float]) -> Quaternion:
    """Return a row of an array, or any four numbers, as a plain tuple of floats."""
    w, x, y, z = q
    return (float(w), float(x), float(y), float(z))


def to_matrix_one(q: Quaternion) -> tuple[Vector, Vector, Vector]:
    """Return the rows of the rotation matrix of a unit quaternion."""
    w, x, y, z = q
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
