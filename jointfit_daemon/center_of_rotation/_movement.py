"""Input of the estimators: marker positions, body poses and joint angles.

Positions are in meters, NaN where a marker was not visible. The poses of parent and child are given
in the same world coordinates.
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
"""Largest rotation of the child relative to the parent that the parent's marker noise may cause,
rad.

Noise of 1 mm of markers 10 cm from their mean rotates the fitted parent frame by half of this
value. Such rotations cannot be distinguished from joint rotations.
"""


@dataclass(frozen=True, slots=True)
class BodyPoses:
    """Pose of a body part over time: a point x of the body is at R(q) x + t in the world."""

    q: Array
    """q_world_body, scalar first, shape (n, 4); NaN where not known."""
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
    """Markers of the child in the parent's coordinates, m, shape (n, k, 3), or (n, k, 2) in a
    plane."""
    parent: BodyPoses | None = None
    child: BodyPoses | None = None
    parent_markers: Array | None = None
    """The parent's own markers in its coordinates, m, shape (m, 3). If given, the effect of their
    noise on `points` is separated from the noise of the child's markers."""
    child_markers: Array | None = None
    """The child's own markers in its coordinates, m, shape (k, 3). None: the median of `points` in
    the child's coordinates, if `child` is given."""
    residuals: Array | None = None
    """Residual of the cameras for each of `points`, m, shape (n, k); NaN where unknown. Only ratios
    of residuals are used: a frame with a larger residual is noisier."""
    angles: Array | None = None
    """Angle of the child about the joint's axis relative to the parent, rad, shape (n,), from
    inertial sensors: for ``oriented``."""
    axis: Array | None = None
    """Normal of the plane for planar methods on points in space, shape (3,); estimated if None."""
    near: Array | None = None
    """Initial center, m, shape (d,); the mean of the markers if None. Along unobserved directions
    the estimate keeps the initial value."""
    interval: float = 0.01
    """Time between frames, s."""

    def both_markers(self) -> tuple[Array, Array] | None:
        """Return the markers of parent and child in own coordinates, m, shape (n, k, 3) each.

        None if the markers of either body are unknown, fewer than three, or on a line.
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
        """Return the largest apparent rotation due to noise of a moving parent's frame, rad."""
        return PARENT_TURN_RAD if self.parent is not None else 0.0
