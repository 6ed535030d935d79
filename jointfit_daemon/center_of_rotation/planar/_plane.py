"""Coordinates of markers in the plane of a segment, and the plane normal to a joint axis."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array


TOO_CLOSE_M = 1e-6


def in_segment_plane(first: ArrayLike, second: ArrayLike, marker: ArrayLike) -> Array:
    r"""Take a marker to the coordinates of a segment that two markers fix in the plane.

    .. math:: x = R(-\varphi)\,(m - (p_1 + p_2)/2),
              \qquad \varphi = \mathrm{atan2}(p_2 - p_1)

    Parameters
    ----------
    first, second : array_like, shape (..., 2)
        Markers of the parent, m: the origin is midway, x points from the first to the second.
    marker : array_like, shape (..., 2)
        Marker of the child, m.

    Returns
    -------
    ndarray, shape (..., 2)
        m; NaN where a marker is not seen or the parent's two are at one place.
    """
    p, q = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    d = np.asarray(marker, dtype=np.float64) - (p + q) / 2
    along = q - p
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    length = np.where(length > TOO_CLOSE_M, length, np.nan)
    e = along / length
    x = (e * d).sum(axis=-1)
    y = e[..., 0] * d[..., 1] - e[..., 1] * d[..., 0]

    return np.stack((x, y), axis=-1)


def plane_of(axis: ArrayLike) -> Array:
    """Return two unit directions across an axis, right-handed with it, shape (3, 2).

    For x they are exactly y and z. A center (a, b) found in the plane is ``plane @ (a, b)`` in
    space, plus anything along the axis.

    Raises
    ------
    ValueError
        The axis has no length.
    """
    n = np.asarray(axis, dtype=np.float64)
    length = float(np.linalg.norm(n))
    if not length > 0.0:
        raise ValueError("an axis needs a length: (0, 0, 0) has no plane across it")
    n = n / length
    # y is farthest from the axis a hinge of ours has; z stands in where the axis is y
    guide = np.eye(3)[1 if abs(n[1]) < 0.9 else 2]
    first = guide - n * (n @ guide)
    first /= np.linalg.norm(first)

    return np.column_stack((first, np.cross(n, first)))
