"""Conversion of a Hamilton unit quaternion (w, x, y, z) to the formats that devices send."""

from __future__ import annotations

from math import asin, atan2, degrees, sqrt
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_simulators.devices._sensor_errors import Vector
    from jointfit_simulators.imu_device import Quaternion

TINY = 1e-12
"""Rotation angle below which the small-angle limit is used, rad."""


def rotation_rows(q: Quaternion) -> tuple[Vector, Vector, Vector]:
    """Return the rows of the rotation matrix."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def roll_pitch_yaw_deg(q: Quaternion) -> tuple[float, float, float]:
    """Return roll, pitch and yaw, degrees, of R = Rz(yaw) Ry(pitch) Rx(roll)."""
    (xx, _, _), (yx, _, _), (zx, zy, zz) = rotation_rows(q)
    pitch = asin(max(-1.0, min(1.0, -zx)))
    return degrees(atan2(zy, zz)), degrees(pitch), degrees(atan2(yx, xx))


def rotation_vector(q: Quaternion) -> Vector:
    """Return the rotation vector 2 log(q), rad, whose norm is at most pi."""
    w, x, y, z = q if q[0] >= 0.0 else (-q[0], -q[1], -q[2], -q[3])
    length = sqrt(x * x + y * y + z * z)
    scale = 2.0 * atan2(length, w) / length if length > TINY else 2.0
    return (scale * x, scale * y, scale * z)
