"""Conversion of the objects of one Vicon frame to columns: SI units, world z up, NaN if missing.

A subject that is not visible has no object. Positions are in millimetres, and rotation matrices in
row-major order. Global poses are relative to the world. If there are none, light-weight poses are
used. They are relative to the parent segment, so a segment whose parent is not visible counts as
missing.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.kinematics.rotation_scalar import exp_one, multiply_one, rotate_one
from jointfit_daemon.units import M_PER_MM
from jointfit_drivers.motion_capture import (
    ABSENT,
    NO_POSITION,
    is_near,
    matrix_quaternion,
    rows_array,
    world_rotation,
)
from jointfit_drivers.vicon._binding import member_key
from jointfit_protocols import vicon
from jointfit_protocols.vicon import ObjectId

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion, Vector
    from jointfit_drivers.vicon._binding import ViconBinding
    from jointfit_drivers.vicon._scene_state import SceneState

    Pose = tuple[Vector, Quaternion]

_WIDEST = 2 * math.pi
"""Largest plausible component of a rotation vector, rad. A comparison with this value must also
reject NaN."""
_DEEPEST = 200
"""Largest number of segments from a root to an end. A longer chain contains a loop."""


class ViconColumns(NamedTuple):
    """Arrays of one `MocapFrame`, and findings about the frame."""

    markers: Array
    body_positions: Array
    body_orientations: Array
    suspicious: int
    """Number of segments rejected because of an invalid rotation. For light-weight poses, an
    implausible position also counts."""
    unknown: int
    """Number of markers and segments that belong to no subject."""


class ViconPoseConverter:
    """Converts frames of one server to columns.

    Parameters
    ----------
    up_axis : UpAxis
        Axis of the stream that points up.
    """

    def __init__(self, up_axis: str) -> None:
        self._place, self._turn = world_rotation(up_axis)

    def columns(self, state: SceneState, binding: ViconBinding) -> ViconColumns:
        """Return the current frame in the columns of `binding`."""
        unknown = 0
        seen: dict[int, Vector] = {}
        for item in state.dynamic(ObjectId.LABELED_RECONS):
            for recon in item.recons if isinstance(item, vicon.LabeledRecons) else ():
                key = member_key(recon.subject, recon.marker)
                unknown += key not in binding.known_markers
                x, y, z = recon.x * M_PER_MM, recon.y * M_PER_MM, recon.z * M_PER_MM
                if is_near(x, y, z):
                    seen[key] = self._place(x, y, z)

        poses, suspicious = _global_poses(state)
        if not poses and not suspicious:
            poses, suspicious = _chained_poses(state, binding.parents)
        turned = {
            key: (self._place(*position), self._turn(*q)) for key, (position, q) in poses.items()
        }
        unknown += sum(key & 0xFFFFFFFF not in binding.parents.get(key >> 32, {}) for key in poses)

        columns = binding.columns
        rows = [turned.get(key, ABSENT) for key in columns.bodies if isinstance(key, int)]
        places = [seen.get(key, NO_POSITION) for key in columns.markers if isinstance(key, int)]
        return ViconColumns(
            rows_array(places, 3),
            rows_array([place for place, _ in rows], 3),
            rows_array([turn for _, turn in rows], 4),
            suspicious,
            unknown,
        )


def _global_poses(state: SceneState) -> tuple[dict[int, Pose], int]:
    """Return the global poses by key, and the number of rejected poses."""
    poses: dict[int, Pose] = {}
    suspicious = 0
    for item in state.dynamic(ObjectId.GLOBAL_SEGMENTS):
        if not isinstance(item, vicon.Segments):
            continue
        for segment in item.segments:
            x, y, z = (value * M_PER_MM for value in segment.position)
            q = matrix_quaternion(segment.rotation)
            if q is None:
                suspicious += 1
            elif is_near(x, y, z):
                poses[member_key(item.subject, segment.segment)] = (x, y, z), q
    return poses, suspicious


def _chained_poses(
    state: SceneState, parents: dict[int, dict[int, int]]
) -> tuple[dict[int, Pose], int]:
    """Return the global poses that follow from light-weight poses, and the number of rejections."""
    poses: dict[int, Pose] = {}
    suspicious = 0
    for item in state.dynamic(ObjectId.LIGHT_SEGMENTS):
        if not isinstance(item, vicon.LightSegments):
            continue
        local: dict[int, Pose] = {}
        for segment in item.segments:
            x, y, z = segment.x * M_PER_MM, segment.y * M_PER_MM, segment.z * M_PER_MM
            turn = segment.rx, segment.ry, segment.rz
            if is_near(x, y, z) and all(abs(angle) <= _WIDEST for angle in turn):
                local[segment.segment] = (x, y, z), exp_one(turn)
            else:
                suspicious += 1

        of_subject = parents.get(item.subject, {})
        for number in local:
            pose = _chain(number, local, of_subject)
            if pose is not None:
                poses[member_key(item.subject, number)] = pose
    return poses, suspicious


def _chain(number: int, local: dict[int, Pose], parents: dict[int, int]) -> Pose | None:
    """Return the global pose of a segment; None if an ancestor is missing, or in a loop."""
    pose = local.get(number)
    for _ in range(_DEEPEST):
        number = parents.get(number, 0)
        if number == 0 or pose is None:
            return pose
        parent = local.get(number)
        if parent is None:
            return None
        (px, py, pz), q = parent
        x, y, z = rotate_one(q, pose[0])
        pose = (px + x, py + y, pz + z), multiply_one(q, pose[1])
    return None
