r"""Trajectory of a joint in the world, from the centers of rotation fixed in two segments.

A center of rotation is estimated once, in the coordinates of a segment. The position of the joint
in every frame is then computed from the pose of the segment, even if the other segment is occluded.

Invariant: in a frame in which neither segment has a pose, the position is unknown (NaN).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation.planar import planar_noise
from jointfit_daemon.center_of_rotation.spatial import spatial_noise

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation._movement import BodyPoses
    from jointfit_daemon.center_of_rotation._result import CenterEstimate

_LEAST_VARIANCE_M2 = 1e-12
"""Lower limit of the variance of a joint position that is computed from one segment, m². Without
this limit, a segment without noise would have an infinite weight.
"""


@dataclass(frozen=True, slots=True)
class JointSide:
    """One of the two segments of a joint, with the center in its coordinates."""

    poses: BodyPoses
    """Poses of the segment in the world; NaN where unknown."""
    basis: Array
    """Matrix, shape (3, d), that converts segment coordinates, shape (d,), to the coordinates of
    `poses`. It is the identity in space, and the basis of the plane in a planar method.
    """
    markers: Array
    """Markers of the segment in its coordinates, m, shape (m, d)."""
    fit_rms: float
    """RMS residual of the rigid fit to the markers, m."""
    estimate: CenterEstimate
    """Center in the coordinates of the segment."""


@dataclass(frozen=True, slots=True)
class JointTrajectory:
    """Position of a joint in the world over time."""

    positions: Array
    """Position of the joint, m, shape (n, 3); NaN where neither segment has a pose."""
    error: Array
    """Predicted RMS error of the position in the observed directions, m, shape (n,); NaN where the
    position is unknown.
    """
    sides_apart: float
    """RMS distance between the joint positions computed from the two segments, m. A planar method
    uses the distance within the plane. NaN if only one segment is used.
    """


def joint_trajectory(sides: Sequence[JointSide], frames: int) -> JointTrajectory:
    r"""Return the position of a joint in every frame.

    .. math:: x(t) = \sum_k w_k(t)\, (R_k(t)\, c_k + t_k(t)), \qquad
              w_k \propto 1 / (s_k^2 + f_k^2)

    The sum is over the segments k with a pose in frame t. :math:`c_k` is the center in segment k.
    :math:`s_k^2` is the trace of the covariance of the center. :math:`f_k^2` is the trace of the
    covariance of the segment's pose error at the center. Both centers are estimated from the same
    movement, so their errors s are assumed to be fully correlated. The pose errors f are assumed to
    be independent. The predicted error E is

    .. math:: E^2 = \Big( \sum_k w_k s_k \Big)^2 + \sum_k w_k^2 f_k^2

    If the two sides differ by more than their errors predict, E is multiplied by the ratio of
    observed to predicted difference.

    Along the directions that a side did not observe, its center is shifted within the segment, so
    that the mean position agrees with the other side. The side with fewer unobserved directions is
    not shifted. In a planar method, the normal of the plane counts as unobserved. The position
    along the normal is then the mean of the segment's markers.

    Parameters
    ----------
    sides : sequence of JointSide
        One or two segments; a side with a refused center is not used.
    frames : int
        Number of frames n, which is the length of the result if no side is usable.

    Returns
    -------
    JointTrajectory
        Trajectory. The errors are valid for markers that are rigidly fixed to the bone. A radial
        residual beyond the noise of the markers counts as motion of the joint; the cause is
        soft-tissue artefact or a moving center.
    """
    usable = sorted(
        (side for side in sides if side.estimate.refused is None),
        key=lambda side: len(side.estimate.unseen),
    )
    if not usable:
        return JointTrajectory(np.full((frames, 3), np.nan), np.full(frames, np.nan), np.nan)

    tracks = [_in_world(usable[0], usable[0].estimate.center)]
    tracks += [_agreeing_track(side, tracks[0]) for side in usable[1:]]
    x = np.stack(tracks, axis=1)
    known = np.asarray(np.isfinite(x).all(axis=-1))
    fixed = np.array([sqrt(max(float(np.trace(s.estimate.covariance)), 0.0)) for s in usable])
    moving = np.array([_pose_variance(side) for side in usable])
    weight = np.where(known, 1.0 / np.maximum(fixed**2 + moving, _LEAST_VARIANCE_M2), 0.0)
    total = weight.sum(axis=1, keepdims=True)
    weight = np.divide(weight, total, out=np.full_like(weight, np.nan), where=total > 0.0)

    error = np.sqrt((weight @ fixed) ** 2 + weight**2 @ moving)
    both = np.flatnonzero(known.all(axis=1)) if len(usable) > 1 else np.zeros(0, dtype=np.intp)
    if both.size == 0:
        apart = np.nan
    else:
        gap = (x[both, 0] - x[both, 1]) @ usable[0].basis
        apart = sqrt(float((gap**2).sum(axis=1).mean()))
        predicted = sqrt(float((fixed**2 + moving).sum()))
        error *= max(1.0, apart / max(predicted, sqrt(_LEAST_VARIANCE_M2)))

    positions = (weight[..., None] * np.where(known[..., None], x, 0.0)).sum(axis=1)
    return JointTrajectory(positions, error, apart)


def _in_world(side: JointSide, center: Array) -> Array:
    return side.poses.to_world(side.basis @ center)


def _agreeing_track(side: JointSide, reference: Array) -> Array:
    """Return the positions from one side, shifted to `reference` along unobserved directions.

    After the shift, the result and `reference` have the same mean along these directions.
    """
    center, unseen = side.estimate.center, side.estimate.unseen
    other = side.poses.to_body(reference[:, None])[:, 0] @ side.basis
    shared = np.isfinite(other).all(axis=1)
    if not shared.any():
        return _in_world(side, center)
    if len(unseen):
        center = center + unseen.T @ (unseen @ (other[shared].mean(axis=0) - center))

    found = _in_world(side, center)
    if len(center) == len("xy"):  # the mean along the normal of the plane is also shifted
        normal = np.cross(*side.basis.T)
        found = found + normal * ((reference - found)[shared] @ normal).mean()
    return found


def _pose_variance(side: JointSide) -> float:
    """Return the variance of the pose error at the center along the observed directions, m²."""
    m, d = side.markers.shape
    estimate = side.estimate
    # m markers have m·d coordinates; the fit of the pose uses d (d + 1) / 2 degrees of freedom
    noise = side.fit_rms * sqrt(m / (m * d - d * (d + 1) / 2))
    covariance = planar_noise if d == len("xy") else spatial_noise
    of_point = covariance(estimate.center, side.markers, noise)

    # The part of the residual variance that marker noise does not explain is motion of the joint.
    excess = max(estimate.residual**2 - float(np.trace(of_point)) / d, 0.0)
    per_direction = of_point + (excess - noise**2) * np.eye(d)
    unseen = estimate.unseen.reshape(-1, d) if len(estimate.unseen) else np.zeros((0, d))
    hidden = float(np.einsum("ua,ab,ub->", unseen, per_direction, unseen))
    return float(np.trace(per_direction)) - hidden
