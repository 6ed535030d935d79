"""Input of the estimators: marker positions, body poses and joint angles.

Positions are in meters. They are NaN where a marker was not visible. The poses of parent and child
are given in the same world coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import MIN_MARKERS, is_line

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

PARENT_TURN_RAD = radians(0.8)
"""Largest apparent rotation of the child relative to the parent that noise of the parent's markers
may cause, rad.

If the markers are 10 cm from their mean, noise of 1 mm rotates the fitted parent frame by half of
this value. Rotations below this value cannot be distinguished from joint rotations.
"""


@dataclass(frozen=True, slots=True)
class BodyPoses:
    """Pose of a body part over time. A point x of the body has the world position R(q) x + t."""

    q: Array
    """Orientation q_world_body, scalar first, shape (n, 4); NaN where unknown."""
    t: Array
    """Position of the body's origin in the world, m, shape (n, 3)."""

    def to_world(self, x: Array) -> Array:
        """Transform one point of the body, m, shape (3,), to the world, shape (n, 3)."""
        return rotation.rotate(self.q, x) + self.t

    def to_body(self, points: Array) -> Array:
        """Transform points in the world, m, shape (n, k, 3), to the body's coordinates."""
        return rotation.rotate(rotation.conjugate(self.q)[:, None], points - self.t[:, None])


@dataclass(frozen=True, slots=True)
class Movement:
    """Data of a movement; `METHODS` lists the fields that each method needs."""

    points: Array | None = None
    """Marker positions of the child in the parent's coordinates, m, shape (n, k, 3), or (n, k, 2)
    in a plane.
    """
    parent: BodyPoses | None = None
    child: BodyPoses | None = None
    parent_markers: Array | None = None
    """Markers of the parent in the parent's coordinates, m, shape (m, 3). If they are given, the
    effect of their noise on `points` is separated from the noise of the child's markers.
    """
    child_markers: Array | None = None
    """Markers of the child in the child's coordinates, m, shape (k, 3). If None, the median of
    `points` in the child's coordinates is used, which requires `child`.
    """
    residuals: Array | None = None
    """Residual that the optical system reports for each of `points`, m, shape (n, k); NaN where
    unknown. The noise of a position is assumed to be proportional to its residual.
    """
    angles: Array | None = None
    """Angle of the child about the joint's axis relative to the parent, rad, shape (n,). It is
    measured by inertial sensors, for the method ``oriented``.
    """
    axis: Array | None = None
    """Normal of the plane for planar methods on points in space, shape (3,); estimated if None."""
    near: Array | None = None
    """Initial center, m, shape (d,); the mean of the markers if None. Along unobserved directions
    the estimate is equal to the initial center.
    """
    interval: float = 0.01
    """Time between frames, s."""
    names: tuple[str, ...] | None = None
    """Names of the k markers of `points`, for the flags of the estimate; None if unknown."""

    def both_markers(self) -> tuple[Array, Array] | None:
        """Return the markers of parent and child, each in coordinates of its body, m.

        The result is None if the markers of either body are unknown, fewer than three, or on a
        line.
        """
        child = self.child_markers
        if child is None and not (self.points is None or self.parent is None or self.child is None):
            world = rotation.rotate(self.parent.q[:, None], self.points) + self.parent.t[:, None]
            local = self.child.to_body(world)
            placed = np.isfinite(local).all(axis=-1).any(axis=0)
            child = np.nanmedian(local[:, placed], axis=0)

        if self.parent_markers is None or child is None:
            return None
        both = self.parent_markers, child
        return both if all(len(m) >= MIN_MARKERS and not is_line(m) for m in both) else None

    @property
    def least_turn(self) -> float:
        """Return the largest rotation that noise of the parent may cause, rad; 0 without parent."""
        return PARENT_TURN_RAD if self.parent is not None else 0.0
