"""Plane perpendicular to a joint axis."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array


def plane_of(axis: ArrayLike) -> Array:
    """Return two unit vectors normal to an axis, right-handed with the axis, shape (3, 2).

    For the x axis the vectors are exactly y and z. A center (a, b) in the plane is ``plane @ (a,
    b)`` in space, plus any multiple of the axis.

    Raises
    ------
    ValueError
        The axis has the length 0.
    """
    n = np.asarray(axis, dtype=np.float64)
    length = float(np.linalg.norm(n))
    if not length > 0.0:
        raise ValueError("the axis is (0, 0, 0), expected a vector with a length above 0")
    n = n / length
    # y is nearly perpendicular to typical flexion axes; z is used if the axis is close to y
    guide = np.eye(3)[1 if abs(n[1]) < 0.9 else 2]
    first = guide - n * (n @ guide)
    first /= np.linalg.norm(first)

    return np.column_stack((first, np.cross(n, first)))
