"""Centers of rotation from the markers of one body part seen by its neighbour.

Law: points in, one center with its covariance out; which directions the movement showed and which
it did not is part of the answer. A hinge shows its axis and nothing along it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation.spatial import (
    SphereLimits,
    SphereOptions,
    judge_sphere,
    objection,
    solve_sphere,
)
from jointfit_daemon.limb_model import visible

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.anatomy._marker_clusters import ClusterTrack
    from jointfit_daemon.center_of_rotation import CenterEstimate


MIN_FRAMES = 50
MAX_FRAMES = 2000
MIN_DIRECTION_RAD = radians(3.0)
"""RMS change of the markers' directions below which a direction of the center is not observed."""
UNSEEN_SD_M = 0.03
"""Standard deviation given to the center along a direction that the movement did not show."""
MAX_SD_M = 0.04
"""Standard deviation, in a direction that was observed, above which a center is refused."""
LIMITS = SphereLimits(min_arc=radians(10.0), reach=(0.02, 1.0))
ON_SKIN = SphereOptions(
    smallest_scale=1e-4, hold=0.003, min_direction=MIN_DIRECTION_RAD, keep_one=True
)
_STEEP = 0.5  # smallest horizontal part of an unobserved direction to slide along


@dataclass(frozen=True, slots=True)
class CenterOfRotation:
    """A point at rest in one body part and in its neighbour, as far as the movement shows it."""

    center: Array
    """m, shape (3,), in the coordinates of the points given."""
    covariance: Array
    """m², shape (3, 3); already widened for residuals that persist from frame to frame."""
    residual_rms: float
    """RMS of the markers' distances to the center about their means, m."""
    frames: int
    arc: float
    """Angle that the markers went through about the center, rad (4 times the RMS direction)."""
    unseen: Array
    """Unit directions in which nothing was observed, shape (0..2, 3)."""
    leverage: Array
    """Covariance of the center for every m² of radial skin motion that goes with posture, shape
    (3, 3): such motion repeats, so no number of frames averages it away."""
    refused: str | None = None
    """Why the center must not be used; None if it may."""


def fit_center(points: Array, start: Array) -> CenterOfRotation:
    r"""Fit the point that each marker keeps its own distance from.

    .. math:: \min_m \sum_{tj} \rho\left(|v_{tj} - m| - \bar u_j\right),
              \qquad \bar u_j = \mathrm{mean}_t |v_{tj} - m|

    The geometric fit of `center.sphere`, set for skin: directions in which the markers turned less
    than `MIN_DIRECTION_RAD` are left at `start`, where skin would rule, with `UNSEEN_SD_M`.

    Parameters
    ----------
    points : ndarray, shape (n, k, 3)
        Markers of the child in the parent's coordinates, m; NaN where not seen.
    start : ndarray, shape (3,)
        Where to begin and where to stay in unobserved directions, m.

    Returns
    -------
    CenterOfRotation
        With `refused` set where there are too few frames, no arc, or an absurd radius.
    """
    points = _thin(points)
    seen = visible(points)
    frames = int(np.count_nonzero(seen.any(axis=1)))
    if frames < MIN_FRAMES:
        return _refused(start, frames, f"{frames} usable frames, at least {MIN_FRAMES} are needed")
    options = replace(ON_SKIN, start=np.asarray(start, dtype=np.float64))
    fit = solve_sphere(points, options)
    found = judge_sphere(fit, "sphere", frames, LIMITS, options)
    lever = fit.basis @ np.linalg.pinv(fit.information / max(float(fit.weights.sum()), 1e-12))
    return CenterOfRotation(
        fit.center,
        found.covariance + UNSEEN_SD_M**2 * fit.unseen.T @ fit.unseen,
        found.residual,
        frames,
        found.arc,
        fit.unseen,
        lever @ fit.basis.T,
        _objection(found, found.covariance),
    )


def _thin(points: Array) -> Array:
    return points[:: max(1, -(-len(points) // MAX_FRAMES))]


def _objection(found: CenterEstimate, shown: Array) -> str | None:
    if found.radii.size == 0:
        return found.refused
    if (basic := objection(found.arc, float(np.median(found.radii)), np.inf, LIMITS)) is not None:
        return basic
    sd = float(np.sqrt(np.linalg.norm(shown, 2)))
    if sd > MAX_SD_M:
        return f"uncertain to {1000 * sd:.0f} mm: move this joint further, and in other directions"
    return None


def _refused(start: Array, frames: int, reason: str) -> CenterOfRotation:
    wide = np.eye(3)
    none = np.zeros((0, 3))
    at = np.asarray(start, float)
    return CenterOfRotation(at, wide, np.inf, frames, 0.0, none, np.zeros((3, 3)), reason)


def slide_under(found: CenterOfRotation, above: Array | None) -> CenterOfRotation:
    """Move a center along its unobserved directions to come straight over or under a point.

    A hinge does not show where along its axis the joint is. Nearly vertical directions stay as they
    are: nothing above or below says how high a joint is.

    Parameters
    ----------
    found : CenterOfRotation
        In coordinates whose z is vertical.
    above : ndarray, shape (2,), or None
        Horizontal place to come to, m; None: the center stays where its fit left it.
    """
    if len(found.unseen) == 0 or above is None:
        return found
    steps = _pinv(found.unseen[:, :2].T) @ (above - found.center[:2])
    return replace(found, center=found.center + steps @ found.unseen)


def _pinv(A: Array) -> Array:
    U, s, Vt = np.linalg.svd(A, full_matrices=False)
    inverse = np.where(s > _STEEP, 1.0 / np.maximum(s, _STEEP), 0.0)
    return np.asarray(Vt.T @ (inverse[:, None] * U.T))


def joint_center(parent: ClusterTrack, child: ClusterTrack, start: Array) -> CenterOfRotation:
    """Fit the center between two body parts, in static-world coordinates, m (shape (3,)).

    The child's markers are taken to the parent's static-world coordinates first (C1), where the
    center stands still.
    """
    return fit_center(parent.to_static(child.points), start)


def carried_gap(parent: ClusterTrack, child: ClusterTrack, center: Array) -> float:
    """Return how far apart the two body parts carry one center, RMS, m: a figure of quality."""
    gap = np.linalg.norm(parent.carry(center) - child.carry(center), axis=-1)
    gap = gap[np.isfinite(gap)]
    return float(np.sqrt((gap**2).mean())) if gap.size else float("inf")
