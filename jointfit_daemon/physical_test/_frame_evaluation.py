"""Check of world, axes and direction of quaternions, by three rotations about known axes.

A sensor at rest with its z axis up is rotated three times by 90 degrees:

1. about the vertical, counter-clockwise seen from above;
2. about its own x axis, so that its y axis points up;
3. about the vertical again, counter-clockwise.

Let ``q_0`` be the orientation before the first rotation, and ``q_k`` the orientation after rotation
k. ``q_1 q_0*`` and ``q_3 q_2*`` must be +90 degrees about z in the world, and ``q_1* q_2`` must be
+90 degrees about x in the sensor. Together the rotations determine the convention except for the
heading. A device that sends the inverse quaternion exchanges world and sensor. The test detects
this, because the axes of rotations 1 and 3 are equal in the world, but perpendicular in the sensor.

If a device exchanges components or signs of q, it applies an orthogonal transformation to q. Such a
transformation is always equivalent to rotations of world and sensor that are applied to q or to the
inverse of q. If several explanations exist, the simplest is returned.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

TOLERANCE_RAD = radians(25.0)
"""Largest plausible deviation of a manual rotation from 90 degrees, rad. With another convention
the deviation is 90 degrees or more.
"""
_QUARTER = rotation.exp(0.5 * np.pi * np.eye(3)[[2, 0, 2]])
_ORDERS = {"w x y z": (0, 1, 2, 3), "x y z w": (3, 0, 1, 2)}
"""Index of w, x, y and z among the received components."""
_AXES = "xyz"
_PRINTED = "x is +x, y is +y, z is +z"


@dataclass(frozen=True, slots=True)
class FrameFit:
    """Agreement of poses at rest with the three rotations."""

    deviations_rad: tuple[float, float, float]
    """Angle between measured and expected rotation, for each rotation, rad."""

    @property
    def agrees(self) -> bool:
        """Whether all measured rotations agree with the expected rotations."""
        return all(angle <= TOLERANCE_RAD for angle in self.deviations_rad)


def fit_frames(rests: Array) -> FrameFit:
    """Compare the rotations between four poses with the expected rotations.

    Parameters
    ----------
    rests : ndarray, shape (4, 4)
        Canonical orientations q_world_sensor at rest, before the first rotation and after each
        rotation.
    """
    back = rotation.conjugate(rests)
    changes = np.stack(
        (
            rotation.multiply(rests[1], back[0]),
            rotation.multiply(back[1], rests[2]),
            rotation.multiply(rests[3], back[2]),
        )
    )
    one, two, three = rotation.angle_between(_QUARTER, changes).tolist()
    return FrameFit((one, two, three))


def explain_frames(received: Array) -> str:
    """Return a text that names the convention of the received quaternions.

    The rotations determine the order of the components, the direction, and the axes of world and
    sensor. Each axis is rounded to the nearest coordinate axis.

    Parameters
    ----------
    received : ndarray, shape (4, 4)
        Quaternions as received at rest, before the first rotation and after each rotation.
    """
    explanations: list[tuple[int, str]] = []
    for order, index in _ORDERS.items():
        ordered = rotation.normalize(received[:, index])
        for inverse in (False, True):
            axes = _find_axes(rotation.conjugate(ordered) if inverse else ordered)
            if axes is None:
                continue
            up, printed = axes
            unusual = 2 * (printed != _PRINTED) + 2 * (up[1] != "z") + inverse + (index[0] != 0)
            direction = "world to sensor" if inverse else "sensor to world"
            explanations.append(
                (
                    unusual,
                    f"components {order}, {direction}, {up} of the world points up, sensor axes "
                    + ("as printed" if printed == _PRINTED else f"not as printed: {printed}"),
                )
            )
    if explanations:
        return min(explanations, key=lambda each: each[0])[1]

    angles = np.degrees(rotation.angle_between(received[:-1], received[1:]))
    measured = ", ".join(f"{angle:.0f}" for angle in angles)
    return (
        f"no convention explains rotations measured as {measured} deg: repeat the test with "
        "quarter turns about the axes printed on the housing"
    )


def _find_axes(q: Array) -> tuple[str, str] | None:
    """Return the name of the world axis that points up, and the sensor axis of each printed axis.

    The result is None if the rotations differ from 90 degrees by more than the tolerance, or if
    their axes do not agree.
    """
    back = rotation.conjugate(q)
    world = rotation.log(rotation.multiply(q[1:], back[:-1]))
    sensor = rotation.log(rotation.multiply(back[:-1], q[1:]))
    turned = np.linalg.norm(world, axis=1)
    if np.abs(turned - 0.5 * np.pi).max() > TOLERANCE_RAD:
        return None

    # Rotations 1 and 3 are about the vertical, so their axes in the world must be equal.
    up, up_again = world[0] / turned[0], world[2] / turned[2]
    between = np.arctan2(np.linalg.norm(np.cross(up, up_again)), up @ up_again)
    if between > TOLERANCE_RAD:
        return None
    printed = np.stack((sensor[1], sensor[2], sensor[0])) / turned[[1, 2, 0], None]

    names = []
    for axis in (up, *printed):
        k = int(np.argmax(np.abs(axis)))
        if abs(axis[k]) < np.cos(TOLERANCE_RAD):
            return None
        names.append(f"{'+' if axis[k] > 0.0 else '-'}{_AXES[k]}")
    pairs = zip(_AXES, names[1:], strict=True)
    return names[0], ", ".join(f"{axis} is {name}" for axis, name in pairs)
