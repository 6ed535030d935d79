"""Forward kinematics of a right leg: bones and joint centres from joint angles (ground truth).

The *base world* is the world in which the movement of the subject is described. In it, z is up, and
the subject faces +y at pelvis heading 0. The origin of a segment frame is the proximal joint
centre. Its z axis extends from the distal to the proximal joint centre, y is anterior, and x is to
the right.

Invariant: in upright stance every segment frame is parallel to the base world.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_simulators.body._orientation import Rotation

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

PARTS = ("pelvis", "thigh", "shank", "foot")

COORDINATES = 31
"""Number of columns of a coordinate array: the posture of the limb and of the calibration plate."""
PELVIS_POSITION = slice(0, 3)
"""Columns of the pelvis position (mid-pelvis) in the base world, m."""
PELVIS_TURN = slice(3, 6)
"""Columns of the pelvis angles heading (about z), tilt (about x) and list (about y), intrinsic
z-x-y, rad."""
HIP = slice(6, 9)
"""Columns of flexion, adduction and internal rotation, rad. KNEE and ANKLE have the same order."""
KNEE = slice(9, 12)
ANKLE = slice(12, 15)
LEG_ANGLES = slice(6, 15)
PLATE_POSITION = slice(15, 18)
"""Columns of the position of the plate's centre, m."""
PLATE_TURN = slice(18, 21)
"""Columns of the plate's rotation vector, rad."""
ON_PLATE = 21
"""Column with the location of the sensors: 1 on the plate, 0 on the leg, and values between during
the transfer."""
LEFT_HIP = slice(22, 25)
"""Columns of the angles of the left hip, rad, with the signs of the right leg. LEFT_KNEE and
LEFT_ANKLE have the same order."""
LEFT_KNEE = slice(25, 28)
LEFT_ANKLE = slice(28, 31)
LEFT_LEG_ANGLES = slice(22, 31)


@dataclass(frozen=True, slots=True)
class LegGeometry:
    """Bone lengths and joint centres of one leg, m."""

    thigh_m: float = 0.42
    shank_m: float = 0.40
    hip_in_pelvis: tuple[float, float, float] = (0.09, 0.02, -0.07)
    """Hip joint centre in pelvis coordinates (right, anterior, up), m."""
    ankle_height_m: float = 0.08
    """Height of the ankle joint centre above the sole, m."""

    @property
    def standing_pelvis(self) -> tuple[float, float, float]:
        """Pelvis origin in upright stance above the origin of the world, m."""
        leg = self.ankle_height_m + self.shank_m + self.thigh_m
        return (0.0, 0.0, leg - self.hip_in_pelvis[2])

    @property
    def standing_ankle(self) -> tuple[float, float, float]:
        """Ankle joint centre in upright stance, m."""
        return (self.hip_in_pelvis[0], self.hip_in_pelvis[1], self.ankle_height_m)


class LegPose(NamedTuple):
    """Bones at n times in the base world."""

    orientations: dict[str, Rotation]
    """Rotations from part coordinates to the base world at n times, by part."""
    origins: dict[str, Array]
    """Origin of each part, shape (n, 3), m: pelvis origin, hip, knee and ankle."""


def joint_rotation(flexion_sign: int, angles: Array) -> Rotation:
    r"""Return the rotation of a joint of a right leg from its clinical angles.

    .. math:: R = R_x(s f) R_y(a) R_z(i)

    Here *f* is the flexion, *a* the adduction, and *i* the internal rotation, in the order of Grood
    and Suntay. The sign s is +1 for hip flexion and ankle dorsiflexion, and -1 for knee flexion
    (heel back).

    Parameters
    ----------
    flexion_sign
        Sign *s* of the flexion.
    angles
        Flexion, adduction, rotation, rad, shape (n, 3).
    """
    return Rotation.from_euler("XYZ", angles * np.array([flexion_sign, 1, 1]))


def leg_pose(geometry: LegGeometry, coordinates: Array) -> LegPose:
    """Return the bones for coordinates of shape (n, COORDINATES)."""
    pelvis = Rotation.from_euler("ZXY", coordinates[:, PELVIS_TURN])
    thigh = pelvis * joint_rotation(1, coordinates[:, HIP])
    shank = thigh * joint_rotation(-1, coordinates[:, KNEE])
    foot = shank * joint_rotation(1, coordinates[:, ANKLE])

    origin = coordinates[:, PELVIS_POSITION]
    hip = origin + pelvis.apply(np.array(geometry.hip_in_pelvis))
    knee = hip + thigh.apply(np.array([0.0, 0.0, -geometry.thigh_m]))
    ankle = knee + shank.apply(np.array([0.0, 0.0, -geometry.shank_m]))
    return LegPose(
        dict(zip(PARTS, (pelvis, thigh, shank, foot), strict=True)),
        dict(zip(PARTS, (origin, hip, knee, ankle), strict=True)),
    )


def included_angle(thigh: Rotation, shank: Rotation) -> Array:
    """Return the inner angle between two long axes, rad, shape (n,); pi if straight."""
    if not len(thigh):
        return np.empty(0)  # SciPy 1.10 cannot apply an empty rotation
    down = np.array([0.0, 0.0, -1.0])
    a, b = thigh.apply(down), shank.apply(down)
    bend = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))
    return np.pi - np.asarray(bend, dtype=np.float64)
