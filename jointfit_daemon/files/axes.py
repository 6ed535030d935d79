"""Conversion between the axes of files and the axes of the project, where z is up.

The axes are renamed cyclically, so they remain right-handed. A vector (x, y, z) of a file with y
up, as in OpenSim (x forward, y up, z right), becomes (z, x, y). Segment axes are renamed in the
same way.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array

Axis = Literal["x", "y", "z"]
_TO_Z_UP: dict[Axis, list[int]] = {"x": [1, 2, 0], "y": [2, 0, 1], "z": [0, 1, 2]}


def to_z_up(vectors: ArrayLike, up_axis: Axis = "y") -> Array:
    """Return vectors of a file, shape (..., 3), in the axes of the project."""
    return np.asarray(vectors, dtype=np.float64)[..., _TO_Z_UP[up_axis]]


def from_z_up(vectors: ArrayLike, up_axis: Axis = "y") -> Array:
    """Return vectors of the project, shape (..., 3), in the axes of a file."""
    return np.asarray(vectors, dtype=np.float64)[..., np.argsort(_TO_Z_UP[up_axis])]


def quaternions_to_z_up(quaternions: ArrayLike, up_axis: Axis = "y") -> Array:
    """Return normalized quaternions (w, x, y, z) of a file in the axes of the project.

    A quaternion of zeros becomes NaN.
    """
    columns = [0, *(1 + i for i in _TO_Z_UP[up_axis])]
    turned = np.asarray(quaternions, dtype=np.float64)[..., columns]
    norms = np.linalg.norm(turned, axis=-1, keepdims=True)
    unit: Array = turned / np.where(norms > 0.0, norms, np.nan)
    return unit
