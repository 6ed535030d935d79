"""Joint centers from an estimator that rig.toml selects instead of the default sphere fit.

The *static world* is the optical world as it was during the static pose.

Invariant: all coordinates are in the static world. Unobserved directions and leverage have the same
meaning as in `joint_center`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.anatomy._joint_center import (
    MAX_FRAMES,
    MIN_FRAMES,
    artefact_leverage,
    too_uncertain,
)
from jointfit_daemon.center_of_rotation import (
    METHODS,
    BodyPoses,
    Movement,
    estimate_center,
    refusal,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import visible

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration._trial import CenterMethod
    from jointfit_daemon.calibration.anatomy._marker_clusters import ClusterTrack
    from jointfit_daemon.center_of_rotation import CenterEstimate


@dataclass(frozen=True, slots=True)
class CenterChoice:
    """Estimators of the joint centers, and the segment orientations that some estimators need."""

    methods: Mapping[str, CenterMethod] = field(default_factory=dict)
    """Estimator by joint; joints that are absent use ``sphere``."""
    turned: Mapping[str, Array] = field(default_factory=dict)
    """Rotation of each segment since the static pose, q_now_static, computed from its IMUs at the m
    instants of the tracks, shape (m, 4); NaN where unknown."""


def chosen_center(
    method: CenterMethod,
    parent: ClusterTrack,
    child: ClusterTrack,
    start: Array,
    turned: tuple[Array | None, Array | None],
) -> CenterEstimate:
    r"""Estimate the center between two body parts by any method of `METHODS`.

    Planar methods use the plane perpendicular to the joint axis, which is estimated from the poses
    of both parts. They reject a movement about several axes. If the distal part has an IMU, its
    angle θ about the axis a is computed from

    .. math:: q = q_p^* \otimes q_{IMU}, \qquad
              \theta = 2\, \mathrm{atan2}(q_{xyz} \cdot a, q_w),

    where q_p is the rotation of the proximal part since the static pose, from its markers, and
    q_IMU the rotation of the distal part, from its IMU. The method ``oriented`` exchanges the two
    parts if the distal part has no IMU. The center has the same coordinates in both parts, because
    both use the static world.

    Parameters
    ----------
    method : str
        A key of `METHODS`.
    parent, child : ClusterTrack
        Proximal and distal body part.
    start : ndarray, shape (3,)
        Position that is used along unobserved directions, static world, m.
    turned : (ndarray or None, ndarray or None)
        Rotations q_now_static of both parts from their IMUs, shape (m, 4); None without an IMU.

    Returns
    -------
    CenterEstimate
        Center in the static world, m, with `leverage`. If the center is rejected, `refused`
        contains cause and remedy.
    """
    if method == "oriented" and turned[1] is None:
        parent, child, turned = child, parent, turned[::-1]
    frames = int(np.count_nonzero(visible(parent.q) & visible(child.q)))
    if frames < MIN_FRAMES:
        reason = f"{frames} frames show both body parts, at least {MIN_FRAMES} are needed"
        return refusal(method, 3, frames, reason)

    # The origin of both parts is `start`, which is near the joint. At a distant origin, the noise
    # of the rotations would cause large errors of the positions.
    step = max(1, -(-len(parent.t_ns) // MAX_FRAMES))
    above, below = (
        BodyPoses(part.q[::step], part.carry(start)[::step]) for part in (parent, child)
    )
    points = parent.to_static(child.points)[::step] - start
    interval = step * float(np.median(np.diff(parent.t_ns))) / 1e9
    residuals = None if child.residuals is None else child.residuals[::step]
    movement = Movement(
        points,
        above,
        below,
        residuals=residuals,
        near=np.zeros(3),
        interval=interval,
        names=child.markers,
    )
    if METHODS[method].planar:
        hinge = estimate_center(movement, "sara")
        if hinge.axis is None or hinge.refused is not None:
            return replace(refusal(method, 3, frames, hinge.refused or ""), arc=hinge.arc)
        movement = replace(movement, axis=hinge.axis)
        if (imu := turned[1]) is not None:
            q = rotation.multiply(rotation.conjugate(above.q), imu[::step])
            movement = replace(movement, angles=2.0 * np.arctan2(q[:, 1:] @ hinge.axis, q[:, 0]))

    found = estimate_center(movement, method)
    if found.refused is None:
        lever = artefact_leverage(points, found.center, found.unseen)
        if method == "oriented" and movement.angles is not None:
            lever = _angle_leverage(movement.angles, found.unseen)
        found = replace(found, leverage=lever, refused=too_uncertain(found))
    return replace(found, center=found.center + start)


def _angle_leverage(angles: Array, unseen: Array) -> Array:
    r"""Return the covariance of a center per m² of artefact variance for known angles, (3, 3).

    In the plane, the position of a marker in frame t is linear in the center c and in the marker p
    on the segment, :math:`x_t = c + R(\theta_t) p`. The covariance for one observation of unit
    variance is

    .. math:: L = I / (1 - |\bar z|^2), \qquad \bar z = \mathrm{mean}_t\, e^{i \theta_t}.
    """
    z = np.exp(1j * angles[np.isfinite(angles)])
    across = np.eye(3) - unseen.T @ unseen
    return np.asarray(across / max(1.0 - abs(z.mean()) ** 2, 1e-12))
