"""Optical reference: segments and joints of a calibrated limb in one mocap frame.

Invariant: the result does not depend on an IMU, so it is an independent reference for fusion.
"""

from __future__ import annotations

from math import dist
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.fusion._cluster_pose import ClusterPose
from jointfit_daemon.kinematics.joint_angles import read_joint
from jointfit_daemon.kinematics.rotation_scalar import multiply_one
from jointfit_daemon.limb_model import (
    angle_convention,
    body_parts,
    flexion_sign,
    inner_joints,
    is_left,
    joint_parts,
    restore_cluster,
)

if TYPE_CHECKING:
    from jointfit_daemon.kinematics.joint_angles import JointReading
    from jointfit_daemon.limb_model import Calibration, MarkerCluster
    from jointfit_daemon.model import Chain, MocapFrame, MocapLayout, Quaternion, Vector


class OpticalReading(NamedTuple):
    """A limb in one mocap frame, in the order of the chain. Unknown values are None."""

    segments: list[Quaternion | None]
    """Orientation q_optical_segment of each segment."""
    positions: list[Vector | None]
    """Joint centers, m. Each is the mean of two centers, which are fixed in the two adjacent body
    parts. If only one part is visible, the center fixed in this part is used alone.
    """
    gaps: list[float | None]
    """Distance between the two centers of each joint, which are fixed in the two adjacent body
    parts, m.
    """
    joints: list[JointReading | None]
    """Angles of the joints between two segments; None at the ends of the chain."""


class OpticalLimb:
    r"""Computes the optical reference from the marker clusters of a calibration.

    Let (R, t) be the rigid motion of a body part since the static pose. The segment of the part has
    the orientation :math:`R\,R_{static}`, and a joint center c fixed in the part moves to :math:`R
    c + t`. Each joint has two such centers, one fixed in each adjacent part. The distance between
    them is the gap; it is caused by soft-tissue artefact and errors of the center.

    Parameters
    ----------
    chain : Chain
        The limb.
    calibration : Calibration
        Marker clusters, joint centers and segment axes. It must fit the chain.
    """

    def __init__(self, chain: Chain, calibration: Calibration) -> None:
        self._chain = chain
        self._parts: list[tuple[MarkerCluster, list[int]] | None] = []
        """Cluster of each body part, from proximal to distal, with the joints fixed in the part."""
        self._static = [calibration.segment[name].q_static for name in chain.segments]
        self._signs = [flexion_sign(joint) for joint in chain.joints]
        self._conventions = [angle_convention(chain, i) for i in range(len(chain.joints))]
        self._layout: MocapLayout | None = None
        self._poses: list[ClusterPose | None] = []

        centers = [calibration.joint.get(joint) for joint in chain.joints]
        self._centers = [None if item is None else item.center for item in centers]
        self._inner = {joint.number: joint for joint in inner_joints(chain)}
        adjacent = joint_parts(chain)
        known = {i for i, center in enumerate(self._centers) if center is not None}
        carried = [sorted(i for i in known if k in adjacent[i]) for k in range(len(adjacent) + 1)]
        for part, joints in zip(body_parts(chain), carried, strict=True):
            stored = None if part is None else calibration.clusters.get(part)
            if part is None or stored is None:
                self._parts.append(None)
            else:
                self._parts.append((restore_cluster(part, stored), joints))

    def read(self, frame: MocapFrame) -> OpticalReading:
        """Return the limb in one frame."""
        if frame.layout is not self._layout:
            self._layout = frame.layout
            self._poses = [self._pose(part, frame.layout) for part in self._parts]

        chain = self._chain
        orientations: list[Quaternion | None] = [None] * len(self._parts)
        carried: list[list[Vector]] = [[] for _ in chain.joints]
        for k, pose in enumerate(self._poses):
            fitted = None if pose is None else pose.fit(frame)
            if fitted is None:
                continue
            orientations[k] = fitted.q

            found = self._parts[k]
            for joint, position in zip(
                [] if found is None else found[1], fitted.points, strict=True
            ):
                carried[joint].append(position)

        segments = [
            None if q is None else multiply_one(q, q_static)
            for q, q_static in zip(orientations[1:], self._static, strict=False)
        ]
        return OpticalReading(
            segments,
            [_mean(points) for points in carried],
            [dist(points[0], points[1]) if points[1:] else None for points in carried],
            [self._angles(i, segments) for i in range(len(chain.joints))],
        )

    def _pose(
        self, part: tuple[MarkerCluster, list[int]] | None, layout: MocapLayout
    ) -> ClusterPose | None:
        if part is None:
            return None
        cluster, joints = part
        centers = np.array([self._centers[i] for i in joints], dtype=np.float64).reshape(-1, 3)
        return ClusterPose(cluster, centers, layout)

    def _angles(self, joint: int, segments: list[Quaternion | None]) -> JointReading | None:
        if (inner := self._inner.get(joint)) is None:  # the ends of the chain have no angles
            return None
        proximal, distal = segments[inner.proximal], segments[inner.distal]
        if proximal is None or distal is None:
            return None
        sign, left = self._signs[joint], is_left(self._chain, joint)
        return read_joint(
            proximal, distal, flexion_sign=sign, left=left, convention=self._conventions[joint]
        )


def _mean(points: list[Vector]) -> Vector | None:
    if not points:
        return None
    count = len(points)
    x, y, z = (sum(values) / count for values in zip(*points, strict=True))
    return (x, y, z)
