"""Rotations of the simulator, based on SciPy, with scalar-first quaternions.

Invariant: the kinematics of the estimator are not imported. An error in them therefore cannot be in
the ground truth.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import (
    Rotation,  # noqa: TID251 - independent of the estimator's own rotations
)

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

__all__ = ["Rotation", "from_wxyz", "heading", "to_wxyz"]


def from_wxyz(quaternions: Array) -> Rotation:
    """Return rotations of Hamilton quaternions (w, x, y, z), shape (..., 4)."""
    return Rotation.from_quat(quaternions[..., [1, 2, 3, 0]])


def to_wxyz(rotations: Rotation) -> Array:
    """Return Hamilton quaternions (w, x, y, z), shape (4,) or (n, 4)."""
    quaternions: Array = np.asarray(rotations.as_quat())[..., [3, 0, 1, 2]]
    return quaternions


def heading(angle: float) -> Rotation:
    """Return the rotation by `angle`, rad, about the vertical."""
    return Rotation.from_rotvec([0.0, 0.0, angle])
