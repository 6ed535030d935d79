"""Conversion of positions and orientations to a world with z up; missing data become NaN.

The **world** is rotated: p' = R p and q' = q_R q, where q_R is the quaternion of the rotation
matrix R. The axes of a body remain as the vendor defines them. Positions that are not finite or not
plausible count as missing. Orientations that are not rotations also count as missing.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion, Vector

    Place = Callable[[float, float, float], Vector]
    Turn = Callable[[float, float, float, float], Quaternion]

UpAxis = Literal["x", "y", "z", "-x", "-y", "-z"]
"""Axis of the vendor's world that points up."""

NO_POSITION: Vector = (math.nan, math.nan, math.nan)
NO_ORIENTATION: Quaternion = (math.nan, math.nan, math.nan, math.nan)
ABSENT = (NO_POSITION, NO_ORIENTATION)
"""Pose of a body that is not visible to the cameras."""
NORM_TOLERANCE = 1e-3
"""Largest deviation of a quaternion's norm from 1."""
FARTHEST_M = 10_000.0
"""Largest plausible coordinate, m. A comparison with this value must also reject NaN."""
_MATRIX_TOLERANCE = 1e-2
"""Largest row sum of the absolute elements of RᵀR - I."""
_LEAST_DETERMINANT = 0.5
_HALF = math.sqrt(0.5)


def world_rotation(up_axis: str) -> tuple[Place, Turn]:
    """Return the conversions of positions and of orientations to a world with z up.

    Parameters
    ----------
    up_axis : UpAxis
        Axis of the vendor's world that points up.
    """
    return _WORLDS[up_axis]


def is_near(x: float, y: float, z: float) -> bool:
    """Return whether a position, m, is finite and plausible."""
    return abs(x) <= FARTHEST_M and abs(y) <= FARTHEST_M and abs(z) <= FARTHEST_M


def unit_quaternion(w: float, x: float, y: float, z: float) -> Quaternion | None:
    """Return the normalized quaternion; None if its norm is not 1 within `NORM_TOLERANCE`."""
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not abs(norm - 1.0) <= NORM_TOLERANCE:
        return None
    return w / norm, x / norm, y / norm, z / norm


def matrix_quaternion(r: Sequence[float]) -> Quaternion | None:
    """Return the quaternion of a rotation matrix; None if the matrix is not a rotation.

    Parameters
    ----------
    r : sequence of 9 floats
        Matrix by rows. It is accepted if ‖RᵀR - I‖∞ < 1e-2 and det R > 0.5.
    """
    a, b, c, d, e, f, g, h, i = r
    ab, ac, bc = a * b + d * e + g * h, a * c + d * f + g * i, b * c + e * f + h * i
    aa, bb, cc = a * a + d * d + g * g - 1, b * b + e * e + h * h - 1, c * c + f * f + i * i - 1
    # Comparisons with NaN are false, so the conditions describe acceptance, not rejection.
    orthogonal = (
        abs(aa) + abs(ab) + abs(ac) < _MATRIX_TOLERANCE
        and abs(ab) + abs(bb) + abs(bc) < _MATRIX_TOLERANCE
        and abs(ac) + abs(bc) + abs(cc) < _MATRIX_TOLERANCE
    )
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if not (orthogonal and determinant > _LEAST_DETERMINANT):
        return None

    # Shepperd (1978): divide by the largest component.
    trace = a + e + i
    largest = max(trace, a, e, i)
    if largest == trace:
        w, x, y, z = 1 + trace, h - f, c - g, d - b
    elif largest == a:
        w, x, y, z = h - f, 1 + a - e - i, b + d, c + g
    elif largest == e:
        w, x, y, z = c - g, b + d, 1 - a + e - i, f + h
    else:
        w, x, y, z = d - b, c + g, f + h, 1 - a - e + i
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    return w / norm, x / norm, y / norm, z / norm


def rows_array(rows: Sequence[Vector] | Sequence[Quaternion], width: int) -> Array:
    """Return `rows` as an array of shape (len(rows), width)."""
    return np.array(rows, dtype=np.float64).reshape(len(rows), width)


_WORLDS: dict[str, tuple[Place, Turn]] = {
    "x": (
        lambda x, y, z: (-z, y, x),
        lambda w, x, y, z: (_HALF * (w + y), _HALF * (x - z), _HALF * (y - w), _HALF * (z + x)),
    ),
    "y": (
        lambda x, y, z: (x, -z, y),
        lambda w, x, y, z: (_HALF * (w - x), _HALF * (x + w), _HALF * (y - z), _HALF * (z + y)),
    ),
    "z": (lambda x, y, z: (x, y, z), lambda w, x, y, z: (w, x, y, z)),
    "-x": (
        lambda x, y, z: (z, y, -x),
        lambda w, x, y, z: (_HALF * (w - y), _HALF * (x + z), _HALF * (y + w), _HALF * (z - x)),
    ),
    "-y": (
        lambda x, y, z: (x, z, -y),
        lambda w, x, y, z: (_HALF * (w + x), _HALF * (x - w), _HALF * (y + z), _HALF * (z - y)),
    ),
    "-z": (lambda x, y, z: (x, -y, -z), lambda w, x, y, z: (-x, w, -z, y)),
}
"""Rotation of the world that makes z up, for each up axis: 90° about y or x, or 180° about x. The
first function rotates a position. The second function multiplies a quaternion by the rotation from
the left.
"""
