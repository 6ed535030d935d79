"""Input of the estimators: marker positions, body poses and joint angles.

Positions are in meters, NaN where a marker was not visible. Both body poses of a pair are given in
one world.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from typing import TYPE_CHECKING

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

PARENT_TURN_RAD = radians(0.8)
"""A frame fitted to markers 10 cm from its middle, 1 mm noisy, turns by half of it, and its turns
look like the joint's own."""


@dataclass(frozen=True, slots=True)
class BodyPoses:
    """Pose of a body part over time: a point x of the body is at R(q) x + t in the world."""

    q: Array
    """q_world_body, scalar first, shape (n, 4); NaN where not known."""
    t: Array
    """Position of its origin, m, shape (n, 3)."""

    def to_world(self, x: Array) -> Array:
        """Take one point of the body, m, shape (3,), to the world, shape (n, 3)."""
        return rotation.rotate(self.q, x) + self.t

    def to_body(self, points: Array) -> Array:
        """Take points seen in the world, m, shape (n, k, 3), to the body's coordinates."""
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
    """The parent's own markers in its coordinates, m, shape (m, 3): the effect of their noise on
    the points is then separated from their own."""
    angles: Array | None = None
    """Angle of the child about the joint's axis relative to the parent, rad, shape (n,), from
    inertial sensors: for ``oriented``."""
    axis: Array | None = None
    """Normal of the plane for planar methods on points in space, shape (3,); found if None."""
    near: Array | None = None
    """Where to begin and to stay along unseen directions, m, shape (d,); the markers' mean if
    None."""
    interval: float = 0.01
    """From frame to frame, s."""

    @property
    def least_turn(self) -> float:
        """Return the turning, rad, that may be noise of a moving parent's own frame."""
        return PARENT_TURN_RAD if self.parent is not None else 0.0
