"""Joint centers from the movement of a body part relative to the neighboring part.

Every fit returns a `CenterEstimate` with `leverage`. Its `unseen` directions are the directions in
which the movement did not determine the center. For example, the movement of a hinge does not
determine the position of the center along the axis.

The *static world* is the optical world as it was during the static pose.
"""

from __future__ import annotations

from dataclasses import replace
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._robust_weights import rms
from jointfit_daemon.center_of_rotation import BodyPoses, refusal
from jointfit_daemon.center_of_rotation.spatial import (
    SphereLimits,
    SphereOptions,
    evaluate_sphere,
    fit_score,
    objection,
    solve_sphere,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import MIN_MARKERS, is_line, visible

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.anatomy._marker_clusters import ClusterTrack
    from jointfit_daemon.center_of_rotation import CenterEstimate


MIN_FRAMES = 50
"""Smallest number of frames with visible markers."""
MAX_FRAMES = 2000
"""Largest number of frames that are used; longer recordings are decimated."""
MIN_DIRECTION_RAD = radians(3.0)
"""RMS change of marker directions below which a direction of the center is unobserved, rad."""
UNSEEN_SD_M = 0.03
"""Standard deviation of the center along an unobserved direction, m."""
MAX_SD_M = 0.04
"""Largest standard deviation of an accepted center in the observed directions, m."""
LIMITS = SphereLimits(min_arc=radians(10.0), reach=(0.02, 1.0))
ON_SKIN = SphereOptions(
    smallest_scale=1e-4, hold=0.003, min_direction=MIN_DIRECTION_RAD, keep_one=True
)
"""Options of the sphere fit for skin markers."""
_STEEP = 0.5
"""Smallest horizontal component of an unobserved direction along which a center is moved."""


def fit_center(points: Array, start: Array) -> CenterEstimate:
    r"""Fit the point at a constant distance from each marker.

    .. math:: \min_m \sum_{tj} \rho\left(|v_{tj} - m| - \bar u_j\right),
              \qquad \bar u_j = \mathrm{mean}_t |v_{tj} - m|

    v_tj is the position of marker j in frame t, m the center and ρ a robust loss. The method is the
    geometric sphere fit with options for skin markers. If the markers rotated by less than
    `MIN_DIRECTION_RAD` in a direction, soft-tissue artefact would dominate the result. The center
    is then left at `start` in this direction, and the direction is listed as unseen.

    Parameters
    ----------
    points : ndarray, shape (n, k, 3)
        Markers of the distal part in coordinates of the proximal part, m; NaN if not visible.
    start : ndarray, shape (3,)
        Initial center, and its value in unobserved directions, m.

    Returns
    -------
    CenterEstimate
        Center with `leverage`. `refused` is set if there are too few frames, the arc is too short,
        the radius is implausible, or the standard deviation is too large.
    """
    points = points[:: max(1, -(-len(points) // MAX_FRAMES))]
    seen = visible(points)
    frames = int(np.count_nonzero(seen.any(axis=1)))
    if frames < MIN_FRAMES:
        reason = f"{frames} usable frames, at least {MIN_FRAMES} are needed"
        return refusal("sphere", 3, frames, reason)

    options = replace(ON_SKIN, start=np.asarray(start, dtype=np.float64))
    fit = solve_sphere(points, options)
    found = evaluate_sphere(fit, "sphere", frames, LIMITS, options)

    # The leverage is the covariance of the center per variance of the radial residuals.
    lever = fit.basis @ np.linalg.pinv(fit.information / max(float(fit.weights.sum()), 1e-12))
    return replace(found, leverage=lever @ fit.basis.T, refused=_objection(found))


def _objection(found: CenterEstimate) -> str | None:
    if found.radii.size == 0:
        return found.refused
    if (basic := objection(found.arc, float(np.median(found.radii)), np.inf, LIMITS)) is not None:
        return basic
    return too_uncertain(found)


def too_uncertain(found: CenterEstimate) -> str | None:
    """Return reason and remedy if the error of a center is too large; None otherwise."""
    sd = float(np.sqrt(np.linalg.norm(found.covariance, 2)))
    if sd > MAX_SD_M:
        return (
            f"the predicted error is {1000 * sd:.0f} mm: move this joint further, and in other "
            "directions"
        )
    return None


def artefact_leverage(points: Array, center: Array, unseen: Array) -> Array:
    r"""Return the covariance of a center per m² of radial soft-tissue artefact, shape (3, 3).

    .. math:: L = \Big[ \mathrm{mean}_{tj}\,(d_{tj} - \bar d_j)(d_{tj} - \bar d_j)^T \Big]^+,
              \qquad d_{tj} = (v_{tj} - m) / |v_{tj} - m|

    in the observed directions, with the symbols of `fit_center`. L is the inverse information of a
    sphere fit with one observation of unit variance. Frames of the same posture have the same
    artefact and therefore do not reduce the result.

    Parameters
    ----------
    points : ndarray, shape (n, k, 3)
        Markers of the distal part in coordinates of the proximal part, m; NaN if not visible.
    center : ndarray, shape (3,)
        Center, m.
    unseen : ndarray, shape (u, 3)
        Unit vectors of the unobserved directions.
    """
    away = points - center
    direction = away / np.linalg.norm(away, axis=-1, keepdims=True)
    spread = (direction - np.nanmean(direction, axis=0))[visible(points)]
    across = np.eye(3) - unseen.T @ unseen
    information = across @ (spread.T @ spread / max(len(spread), 1)) @ across
    return np.asarray(across @ np.linalg.pinv(information, rcond=1e-9) @ across)


def align_vertically(found: CenterEstimate, above: Array | None) -> CenterEstimate:
    """Move a center along its unobserved directions until it is above or below a point.

    A hinge does not determine the position of its center along the axis. The center is not moved
    along nearly vertical directions, because the horizontal position of a neighbor does not
    determine a height.

    Parameters
    ----------
    found : CenterEstimate
        Center in coordinates with vertical z.
    above : ndarray, shape (2,), or None
        Horizontal target position, m; None leaves the center unchanged.
    """
    if len(found.unseen) == 0 or above is None:
        return found

    # The steps are a least-squares solution without directions of small horizontal component.
    U, s, Vt = np.linalg.svd(found.unseen[:, :2].T, full_matrices=False)
    inverse = np.where(s > _STEEP, 1.0 / np.maximum(s, _STEEP), 0.0)
    steps = (Vt.T @ (inverse[:, None] * U.T)) @ (above - found.center[:2])
    return replace(found, center=found.center + steps @ found.unseen)


def joint_center(parent: ClusterTrack, child: ClusterTrack, start: Array) -> CenterEstimate:
    """Fit the center between two body parts, in static-world coordinates.

    `start` is the initial position and the position along unobserved directions, m, shape (3,). The
    markers of the distal part are first transformed to static-world coordinates of the proximal
    part, in which the center is fixed. A sphere fit to these markers determines which directions
    were observed. Along these directions the center is the point that coincides in both parts. The
    sphere fit is not used for these directions, because noise in the proximal markers rotates the
    pose of the proximal part. The rotation moves distant markers off their spheres and biases the
    center.
    """
    found = fit_center(parent.to_static(child.points), start)
    if found.refused is not None:
        return found
    markers = _markers(parent), _markers(child)
    if any(len(m) < MIN_MARKERS or is_line(m) for m in markers):
        return found

    both = fit_score(
        _poses(parent), _poses(child), near=found.center, markers=markers, posture=False
    )
    if not np.isfinite(both.center).all():
        return found

    # Use center and covariance of `both` in the directions that both fits observed.
    kept = both.unseen.T @ both.unseen
    C = both.covariance + kept @ found.covariance @ kept
    unseen = found.unseen.T @ found.unseen
    across = np.eye(3) - unseen
    center = across @ both.center + unseen @ found.center
    return replace(found, center=center, covariance=across @ C @ across)


def _markers(track: ClusterTrack) -> Array:
    """Return the median position of each visible marker in the static world, m, shape (k, 3)."""
    local = track.to_static(track.points)
    local = local[:, visible(local).any(axis=0)]
    return np.asarray(np.nanmedian(local, axis=0))


def _poses(track: ClusterTrack) -> BodyPoses:
    """Return at most `MAX_FRAMES` poses that map static-world points to the optical world."""
    step = max(1, -(-len(track.q) // MAX_FRAMES))
    q, p = track.q[::step], track.p[::step]
    return BodyPoses(q, p - rotation.rotate(q, track.origin))


def carried_center_gap(parent: ClusterTrack, child: ClusterTrack, center: Array) -> float:
    """Return the RMS distance, m, between the centers that are fixed in two body parts.

    `center` is the joint center in the static world, m, shape (3,).
    """
    return rms(np.linalg.norm(parent.carry(center) - child.carry(center), axis=-1), np.inf)
