r"""Approximation of an OpenSim joint by a joint of the chain model.

A rotation by one coordinate becomes a hinge if its axis and center are fixed. Otherwise it becomes
a coupled joint with samples of the motion. A rotation by two or three coordinates becomes a ball
joint. A joint with three translations becomes free, and so does a joint with translations relative
to the ground. Other translations are omitted.

A_i and t_i are the rotation and translation of sample i, φ_i is its angle, and A_rest is the
rotation at angle zero. The axis a and the centers (c in the child, C in the parent) minimize the
error over the range of the coordinates:

.. math:: A_i \approx A_{rest}\exp(a\varphi_i), \qquad
          \min_{c, C} \sum_i |t_i + A_i c - C|^2

A remark states the remaining error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.models._osim_document import GROUND
from jointfit_daemon.files.models._osim_motion import JointMotion
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.chains import CoupledCurve

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.files.models._osim_document import Coordinate, OsimJoint
    from jointfit_daemon.kinematics.chains import JointKind

_ALL = 3
"""Number of rotation axes of a ball joint."""
_SAMPLES = 61
"""Number of samples over the range of a coordinate."""
_AT_HOME = 0.05
"""Weight that regularizes a center toward the origin of the joint's own frame. A distance of 1 cm
costs as much as an error of 0.5 mm."""
_WIDEST = np.pi / 2
"""Half of the evaluated range about the default value, rad, if a coordinate has no finite range of
at most 360 degrees."""
_BEYOND = 0.3
"""Extension of the samples of a coupled joint beyond its range, rad. Some programs do not clamp
coordinates to their range."""
_TELL_M, _TELL_RAD = 1e-4, 1e-3


@dataclass(frozen=True, slots=True)
class NearestJoint:
    """Joint of the chain model in OpenSim's axes; the kind None is a rigid connection."""

    kind: JointKind | None
    rest: Array
    """Transform from child body axes to parent body axes at the joint's zero, shape (4, 4)."""
    center_in_parent: Array
    center: Array
    axis: Array
    limits: tuple[float, float] | None
    remarks: tuple[str, ...]
    path: Array | None = None
    """Samples of a coupled joint: coordinate, quaternion, displacement of its center; shape (n,
    8)."""


def nearest_joint(joint: OsimJoint) -> NearestJoint:
    """Return the approximating joint, with remarks on the differences from the original joint.

    Raises
    ------
    ValueError
        The type of the joint, or of one of its functions, is not supported.
    """
    motion = JointMotion(joint)
    moving = [c for c in joint.coordinates if not c.locked]
    turning = [c for c in moving if c.name in motion.turning]
    shifting = [c for c in moving if c.name in motion.shifting and c not in turning]

    turns, shifts = sampled_joint(joint, motion, {})
    rest = np.eye(4)
    rest[:3, :3], rest[:3, 3] = turns[0], shifts[0]
    welded = NearestJoint(None, rest, shifts[0], np.zeros(3), np.eye(3)[0], None, ())
    remarks = [f"{joint.name}: {c.name} is locked and fixed" for c in joint.coordinates if c.locked]
    if shifting and (joint.parent.body == GROUND or len(shifting) == _ALL):
        if len(moving) < 2 * _ALL:
            remarks.append(f"{joint.name}: moves freely, not only along {_names(moving)}")
        return replace(welded, kind="free", remarks=tuple(remarks))
    if shifting:
        remarks.append(f"{joint.name}: does not slide along {_names(shifting)}")
    if not turning:
        return replace(welded, remarks=tuple(remarks))
    if len(turning) == 1:
        found = _about_one(joint, motion, turning[0], welded)
    else:
        found = _ball(joint, motion, turning, welded)
    return replace(found, remarks=(*remarks, *found.remarks))


def _names(coordinates: list[Coordinate]) -> str:
    return ", ".join(c.name for c in coordinates)


def _span(c: Coordinate) -> tuple[float, float]:
    low, high = max(c.low, c.default - _WIDEST), min(c.high, c.default + _WIDEST)
    if np.isfinite([c.low, c.high]).all() and c.high - c.low <= 2 * np.pi:
        low, high = c.low, c.high
    return (low, high) if low < high else (c.default - 0.1, c.default + 0.1)


def sampled_joint(
    joint: OsimJoint, motion: JointMotion, values: dict[str, Array]
) -> tuple[Array, Array]:
    """Return R, shape (n, 3, 3), and t, m, shape (n, 3), from child body to parent body.

    `values` contains coordinate values, shape (n,). Other coordinates have their default values.
    """
    count = max((len(v) for v in values.values()), default=1)
    defaults = {c.name: np.full(count, c.default) for c in joint.coordinates}
    others = {name: np.zeros(count) for name in motion.turning | motion.shifting}
    own, shifts = motion.at({**others, **defaults, **values})
    above, below = joint.parent.transform, np.linalg.inv(joint.child.transform)
    turned = above[:3, :3] @ own
    shifted = shifts @ above[:3, :3].T + above[:3, 3]
    return turned @ below[:3, :3], shifted + turned @ below[:3, 3]


def _centers(joint: OsimJoint, turns: Array, shifts: Array) -> tuple[Array, Array, float]:
    """Return the center in the parent and in the child, m, and the largest error, m.

    The motion may leave the center undetermined, for example along an axis. In this case the point
    nearest to the joint's own frame is chosen.
    """
    own = joint.child.transform[:3, 3]
    seen = shifts + turns @ own
    middle = seen.mean(axis=0)
    fixed = np.broadcast_to(-np.eye(3), turns.shape)

    design = np.concatenate((turns, fixed), axis=-1).reshape(-1, 6)
    pull = _AT_HOME * np.sqrt(len(turns)) * np.eye(6)
    wanted = np.concatenate(((middle - seen).ravel(), np.zeros(6)))
    shift = np.linalg.lstsq(np.concatenate((design, pull)), wanted, rcond=None)[0]
    missed = np.linalg.norm(seen + turns @ shift[:3] - middle - shift[3:], axis=-1)
    return middle + shift[3:], own + shift[:3], float(missed.max())


def _ball(
    joint: OsimJoint, motion: JointMotion, turning: list[Coordinate], welded: NearestJoint
) -> NearestJoint:
    drawn = np.random.default_rng(0).random((4 * _SAMPLES, len(turning)))
    values = {
        c.name: _span(c)[0] + drawn[:, i] * (_span(c)[1] - _span(c)[0])
        for i, c in enumerate(turning)
    }

    above, own, missed = _centers(joint, *sampled_joint(joint, motion, values))
    remarks = []
    if len(turning) < _ALL:
        remarks.append(f"{joint.name}: rotates about any axis, not only by {_names(turning)}")
    if missed > _TELL_M:
        remarks.append(
            f"{joint.name}: moving center replaced by a fixed one, off by {1000 * missed:.1f} mm"
            " at most"
        )
    return replace(welded, kind="ball", center_in_parent=above, center=own, remarks=tuple(remarks))


def _about_one(
    joint: OsimJoint, motion: JointMotion, coordinate: Coordinate, welded: NearestJoint
) -> NearestJoint:
    """Return the hinge of one coordinate; a coupled joint if axis or center is not fixed."""
    span = _span(coordinate)
    zero = min(max(0.0, span[0]), span[1])
    values = np.concatenate(([zero, *span], np.linspace(*span, _SAMPLES)))
    turns, shifts = sampled_joint(joint, motion, {coordinate.name: values})
    rest, axis, angles, bent = _axis(np.delete(turns, [1, 2], axis=0))
    above, own, missed = _centers(joint, turns[3:], shifts[3:])
    if missed > _TELL_M or bent > _TELL_RAD:
        return _coupled_joint(joint, motion, coordinate, welded)

    ends = _turned_about(rotation.from_matrix(rest), rotation.from_matrix(turns[1:3]), axis)[1]
    limits = (min(ends[0], angles[1]), max(ends[1], angles[-1]))
    transform = np.eye(4)
    transform[:3, :3] = rest
    return replace(
        welded,
        kind="hinge",
        rest=transform,
        center_in_parent=above,
        center=own,
        axis=axis,
        limits=(float(limits[0]), float(limits[1])),
    )


def _coupled_joint(
    joint: OsimJoint, motion: JointMotion, coordinate: Coordinate, welded: NearestJoint
) -> NearestJoint:
    """Return a coupled joint from samples of the motion, and a remark with its largest errors."""
    low, high = _span(coordinate)
    zero = min(max(0.0, low), high)
    values = np.linspace(low - _BEYOND, high + _BEYOND, 2 * _SAMPLES - 1)
    turns, shifts = sampled_joint(joint, motion, {coordinate.name: np.append(values, zero)})
    own = joint.child.transform[:3, 3]
    seen = shifts + turns @ own
    above = seen[-1]
    path = np.column_stack((values, rotation.from_matrix(turns[:-1]), seen[:-1] - above))

    # Every second sample defines the curve. The other samples measure the error of the curve.
    turned, found = CoupledCurve.through(path[::2].tolist()).at(values)
    missed = float(np.linalg.norm(found[:, 1:4] - path[:, 5:], axis=1).max())
    bent = float(np.linalg.norm(turned - turns[:-1], axis=(1, 2)).max() / np.sqrt(2.0))
    remark = f"{joint.name}: {joint.kind} of {coordinate.name} became a coupled joint"
    if missed > _TELL_M or bent > _TELL_RAD:
        remark += f", off by {1000 * missed:.1f} mm and {np.degrees(bent):.1f} degrees at most"
    return replace(
        welded,
        kind="coupled",
        center_in_parent=above,
        center=own,
        limits=(low, high),
        path=path[::2],
        remarks=(remark,),
    )


def _axis(turns: Array) -> tuple[Array, Array, Array, float]:
    """Return rest, axis, angles and largest deviation from the axis, for rotations (n, 3, 3).

    Rest and axis are computed alternately. The rest is the mean of the part of the rotations that
    the hinge does not explain. The axis is the principal direction of the rotations relative to
    this rest. The angle of the first rotation is zero.
    """
    q = rotation.from_matrix(turns)
    rest = q[0]
    axis, angles = _turned_about(rest, q)
    for _ in range(20):
        rest = rotation.average(rotation.multiply(q, rotation.exp(-angles[:, None] * axis)))
        axis, angles = _turned_about(rest, q)

    # The axis is reversed if the angle decreases while the coordinate increases.
    if angles[-1] < angles[1]:
        axis, angles = -axis, -angles
    rest = rotation.multiply(rest, rotation.exp(angles[0] * axis))
    angles = angles - angles[0]
    nearest = rotation.multiply(rest, rotation.exp(angles[:, None] * axis))
    return rotation.to_matrix(rest), axis, angles, float(rotation.angle_between(nearest, q).max())


def _turned_about(rest: Array, q: Array, axis: Array | None = None) -> tuple[Array, Array]:
    """Return axis and angles, rad, of the rotations from `rest` to `q`.

    Without `axis`, it is the principal axis of these rotations.
    """
    v = rotation.log(rotation.multiply(rotation.conjugate(rest), q))
    if axis is None:
        axis = np.asarray(np.linalg.svd(v, full_matrices=False)[2][0])
    return axis, v @ axis
