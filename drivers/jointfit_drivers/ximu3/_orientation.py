r"""Orientation in data messages of an x-IMU3: quaternion, rotation matrix or Euler angles.

.. math:: R = R_z(\psi) R_y(\theta) R_x(\varphi), \qquad v_\mathrm{world} = R\, v_\mathrm{sensor}

with yaw ψ, pitch θ and roll φ. A message contains the angles in the order roll, pitch, yaw.
"""

from __future__ import annotations

from math import isfinite, radians, sqrt
from typing import TYPE_CHECKING, cast

from jointfit_protocols.orientation import angles_quaternion
from jointfit_protocols.ximu3 import DataKind

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.model import Quaternion
    from jointfit_protocols.ximu3 import XImu3Data

_ACCELERATIONS = (DataKind.LINEAR_ACCELERATION, DataKind.EARTH_ACCELERATION)
_WITH_QUATERNION = 7
"""Number of values in an acceleration message of older firmware."""
_ORTHONORMAL = 0.02
"""Largest error of the products of the columns of a valid rotation matrix."""


def is_orientation(message: XImu3Data) -> bool:
    """Return whether a message contains an orientation."""
    if message.kind in {DataKind.QUATERNION, DataKind.MATRIX, DataKind.EULER}:
        return True
    return message.kind in _ACCELERATIONS and len(message.values) == _WITH_QUATERNION


def orientation_of(message: XImu3Data) -> Quaternion | None:
    """Return the quaternion of a message with an orientation, in the world of the device.

    Return None if a rotation matrix is not orthonormal, or if an Euler angle is not finite.
    """
    values = message.values
    if message.kind == DataKind.MATRIX:
        return _quaternion_of_matrix(values)
    if message.kind == DataKind.EULER:
        if not all(map(isfinite, values)):
            return None
        roll, pitch, yaw = map(radians, values)
        return angles_quaternion(roll, pitch, yaw)
    return cast("Quaternion", values[:4])


def _quaternion_of_matrix(rows: Sequence[float]) -> Quaternion | None:
    xx, xy, xz, yx, yy, yz, zx, zy, zz = rows
    products = (
        xx * xx + yx * yx + zx * zx - 1.0,
        xy * xy + yy * yy + zy * zy - 1.0,
        xz * xz + yz * yz + zz * zz - 1.0,
        xx * xy + yx * yy + zx * zy,
        xx * xz + yx * yz + zx * zz,
        xy * xz + yy * yz + zy * zz,
    )
    volume = xx * (yy * zz - yz * zy) - xy * (yx * zz - yz * zx) + xz * (yx * zy - yy * zx)
    if not all(abs(value) <= _ORTHONORMAL for value in products) or not volume > 0.0:
        return None

    # The largest of 4w², 4x², 4y² and 4z² yields one component. The other components follow from
    # divisions by this component.
    squares = (1.0 + xx + yy + zz, 1.0 + xx - yy - zz, 1.0 - xx + yy - zz, 1.0 - xx - yy + zz)
    largest = squares.index(max(squares))
    double = sqrt(squares[largest])
    scale = 0.5 / double
    a, b, c = (zy - yz) * scale, (xz - zx) * scale, (yx - xy) * scale
    d, e, f = (xy + yx) * scale, (xz + zx) * scale, (yz + zy) * scale
    half = 0.5 * double
    found = ((half, a, b, c), (a, half, d, e), (b, d, half, f), (c, e, f, half))
    return found[largest]
