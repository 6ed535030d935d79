"""Coordinates of OpenSim joints as functions of the pose of a chain model.

The coordinates have the names, signs and axes of OpenSim, because the functions in the OpenSim file
compute them.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.axes import to_z_up
from jointfit_daemon.files.models._osim_joints import sampled_joint
from jointfit_daemon.files.models._osim_motion import JointMotion
from jointfit_daemon.kinematics.chain_coordinates import JointCoordinates, euler_coordinates

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.files.models._osim_document import OsimJoint
    from jointfit_daemon.kinematics.chains import Segment

_X, _Y, _Z = to_z_up(np.eye(3)).argmax(axis=1).tolist()
"""Indices of the chain axes that correspond to OpenSim's x, y and z."""


def joint_coordinates(segment: Segment, joint: OsimJoint, placed: Array) -> JointCoordinates:
    """Return the coordinates that move the child of a joint and are not locked, in file order.

    Parameters
    ----------
    segment
        Segment of the chain model that the joint moves.
    joint
        Joint as read from the file.
    placed
        Pose of the joint's parent body in the segment that contains this body, in OpenSim's axes,
        shape (4, 4).
    """
    motion = JointMotion(joint)
    is_free = segment.joint.kind == "free"
    driving = motion.turning | (motion.shifting if is_free else frozenset())
    names = tuple(c.name for c in joint.coordinates if c.name in driving and not c.locked)
    if segment.joint.kind == "coupled":
        return JointCoordinates(segment.name, names, (True,), None)

    second = motion.second_rotation
    return JointCoordinates(
        segment.name,
        names,
        tuple(name in motion.turning for name in names),
        partial(_pose, joint, motion, placed, names),
        names.index(second) if second in names else None,
    )


def unnamed_coordinates(segment: str) -> JointCoordinates:
    """Return coordinates of a body without joint or without its parent, in OpenSim's axes."""
    return euler_coordinates(segment, is_free=True, order=(_X, _Y, _Z))


def _pose(
    joint: OsimJoint, motion: JointMotion, placed: Array, names: tuple[str, ...], values: Array
) -> tuple[Array, Array]:
    """Return rotation, shape (n, 3, 3), and origin, m, shape (n, 3), of the child body.

    Both have the axes of the chain. `values` has shape (n, len(names)).
    """
    given = {name: values[:, k] for k, name in enumerate(names)}
    turns, shifts = sampled_joint(joint, motion, given)
    turned = to_z_up(to_z_up(placed[:3, :3] @ turns).swapaxes(-1, -2)).swapaxes(-1, -2)
    return turned, to_z_up(shifts @ placed[:3, :3].T + placed[:3, 3])
