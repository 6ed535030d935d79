"""Centers of rotation from the markers of one body part seen by its neighbour.

Law: points in, one center with its covariance out; which directions the movement showed and which
it did not is part of the answer. A hinge shows its axis and nothing along it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import radians
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jointfit_daemon.calibration.markers import visible
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from jointfit_daemon.calibration.markers import ClusterTrack, Mask

Array = NDArray[np.float64]

MIN_FRAMES = 50
MAX_FRAMES = 2000
MIN_DIRECTION_RAD = radians(3.0)
"""RMS change of the markers' directions below which a direction of the center is not observed."""
NOISE_FACTOR = 6.0
"""... or this many times the variance that noise alone gives to those directions."""
UNSEEN_SD_M = 0.03
"""Standard deviation given to the center along a direction that the movement did not show."""
REACH_M = (0.02, 1.0)
MIN_ARC_RAD = radians(10.0)
MAX_SD_M = 0.04
"""Standard deviation, in a direction that was observed, above which a center is refused."""
HUBER = 1.5
_PASSES = 30
_ROUNDED = 1e-4  # smallest radial scale, m
_HOLD_M = 0.003
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

    Gauss-Newton with Huber weights, radii profiled out (Halvorsen 2003; Chang and Pollard 2007).
    Directions that the movement does not show (least direction changes below `MIN_DIRECTION_RAD`,
    or not above noise) are left at `start`: noise would pull them to the markers' own plane with
    false confidence. The covariance is the inverse information times (1+r)/(1-r), r the residuals'
    correlation from one frame to the next.

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
    v = np.where(seen[..., None], points, 0.0)
    m, basis, weights = _solve(v, seen, np.asarray(start, dtype=np.float64))
    return _judged(m, basis, v, seen, weights)


def _thin(points: Array) -> Array:
    return points[:: max(1, -(-len(points) // MAX_FRAMES))]


def _solve(v: Array, seen: Mask, start: Array) -> tuple[Array, Array, Array]:
    """Return center, basis of the observed directions (3, r) and the last weights."""
    weights: Array = seen.astype(np.float64)
    m = _begin(v, weights, start)
    basis: Array = np.eye(3)
    for _ in range(_PASSES):
        e, J = _residual(v, m, weights)
        scale = max(1.4826 * float(np.median(np.abs(e[seen]))), _ROUNDED)
        huber = np.minimum(1.0, HUBER * scale / np.maximum(np.abs(e), 1e-12))
        weights = np.where(seen, huber, 0.0)
        e, J = _residual(v, m, weights)
        basis = _observed(v, m, weights, scale)
        Jb = J @ basis
        H = np.einsum("tj,tja,tjb->ab", weights, Jb, Jb)
        g = np.einsum("tj,tja,tj->a", weights, Jb, e)
        # far from the answer the radii are wrong and full steps overshoot: never more than 0.2 m
        step = basis @ np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(len(H)), -g)
        step *= min(1.0, 0.2 / max(float(np.linalg.norm(step)), 1e-12))
        m = start + basis @ (basis.T @ (m + step - start))
        if np.linalg.norm(step) < 1e-8:
            break
    return m, basis, weights


def _begin(v: Array, w: Array, start: Array) -> Array:
    """Return Gamage and Lasenby's linear center, held to `start` where 3 mm of noise would rule."""
    total = np.maximum(w.sum(axis=0), 1e-12)
    d = v - start
    d = d - (w[..., None] * d).sum(axis=0) / total[:, None]
    square = ((v - start) ** 2).sum(axis=-1)
    square = square - (w * square).sum(axis=0) / total
    A = 2.0 * np.einsum("tj,tja,tjb->ab", w / total, d, d)
    b = np.einsum("tj,tja,tj->a", w / total, d, square)
    held = 2.0 * len(total) * _HOLD_M**2 * np.eye(3)
    return np.asarray(start + np.linalg.solve(A + held, b))


def _residual(v: Array, m: Array, w: Array) -> tuple[Array, Array]:
    """Return radial residuals (n, k) and their derivatives by the center (n, k, 3)."""
    d = v - m
    u = np.linalg.norm(d, axis=-1)
    total = np.maximum(w.sum(axis=0), 1e-12)
    e = u - (w * u).sum(axis=0) / total
    direction = d / np.maximum(u, 1e-9)[..., None]
    J = -(direction - (w[..., None] * direction).sum(axis=0) / total[:, None])
    return e, J


def _observed(v: Array, m: Array, w: Array, scale: float) -> Array:
    """Return an orthonormal basis (3, r), r >= 1, of the directions the movement shows.

    Noise turns a marker's direction across its own line of sight only, so the floor of each
    direction b is scaled by the mean of 1 - (b·u)².
    """
    _, J = _residual(v, m, w)
    total = w.sum()
    spread, axes = np.linalg.eigh(np.einsum("tj,tja,tjb->ab", w, J, J) / total)
    d = v - m
    u2 = np.maximum((d**2).sum(axis=-1), 1e-4)
    along = np.einsum("tj,tja,tjb->ab", w / u2, d, d) / total
    across = 1.0 - np.einsum("ai,ab,bi->i", axes, along, axes)
    floor = max(MIN_DIRECTION_RAD**2, NOISE_FACTOR * scale**2 * float((w / u2).sum() / total))
    keep = spread >= floor * np.maximum(across, 0.0)
    keep[-1] = True
    return np.asarray(axes[:, keep])


def _judged(m: Array, basis: Array, v: Array, seen: Mask, w: Array) -> CenterOfRotation:
    frames = int(np.count_nonzero(seen.any(axis=1)))
    e, J = _residual(v, m, w)
    n, free = int(np.count_nonzero(seen)), seen.shape[1] + basis.shape[1]
    variance = float((w * e**2).sum()) / max(n - free, 1)
    persistence: float = _persistence(e, seen)
    Jb = J @ basis
    H = np.einsum("tj,tja,tjb->ab", w, Jb, Jb)
    unseen = _complement(basis)
    shown = np.linalg.pinv(H) * variance * (1 + persistence) / (1 - persistence)
    C = basis @ shown @ basis.T + UNSEEN_SD_M**2 * unseen.T @ unseen
    arc = 4.0 * float(np.sqrt(np.einsum("tja,tja->", w[..., None] * J, J) / max(w.sum(), 1e-12)))
    radius = float(np.median(np.linalg.norm(v - m, axis=-1)[seen]))
    rms = float(np.sqrt((e[seen] ** 2).mean()))
    lever = basis @ np.linalg.pinv(H / max(float(w.sum()), 1e-12)) @ basis.T
    return CenterOfRotation(m, C, rms, frames, arc, unseen, lever, _objection(arc, radius, shown))


def _persistence(e: Array, seen: Mask) -> float:
    """Return the lag-one correlation of the residuals, 0 to 0.99."""
    both = seen[1:] & seen[:-1]
    power = float((e[seen] ** 2).sum()) / max(int(np.count_nonzero(seen)), 1)
    if power < 1e-18 or not both.any():
        return 0.0
    return float(np.clip((e[1:] * e[:-1])[both].mean() / power, 0.0, 0.99))


def _complement(basis: Array) -> Array:
    U = np.linalg.svd(basis, full_matrices=True)[0]
    return np.asarray(U[:, basis.shape[1] :].T)


def _objection(arc: float, radius: float, shown: Array) -> str | None:
    if arc < MIN_ARC_RAD:
        return f"the joint turned {np.degrees(arc):.0f}° only: move through at least 30°"
    if not REACH_M[0] <= radius <= REACH_M[1]:
        return f"the markers would be {radius:.2f} m from the center: check marker names"
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


def common_center(parent: ClusterTrack, child: ClusterTrack) -> tuple[Array, float]:
    r"""Fit one point per body part such that both carry it to the same place (SCoRE).

    .. math:: \min \sum_t |R_1 c_1 + t_1 - R_2 c_2 - t_2|^2

    Treats both body parts alike, needs three markers on each. Directions with singular values below
    a tenth of the next are set to zero motion (SARA's case; Ehrig et al. 2006, 2007).

    Returns
    -------
    center, ratio : ndarray shape (3,), float
        The parent's point in static-world coordinates, m, and the last singular value over the one
        before: below 0.3 only an axis was observed and the point lies anywhere along it.
    """
    good = visible(parent.q) & visible(child.q)
    R1, R2 = rotation.to_matrix(parent.q[good]), rotation.to_matrix(child.q[good])
    N = np.concatenate((R1, -R2), axis=2).reshape(-1, 6)
    rhs = (child.p[good] - parent.p[good]).reshape(-1)
    U, s, Vt = np.linalg.svd(N, full_matrices=False)
    ratio = float(s[5] / s[4])
    inverse = np.where(np.arange(6) < (6 if ratio >= 0.3 else 5), 1.0 / s, 0.0)
    c = Vt.T @ (inverse * (U.T @ rhs))
    return np.asarray(c[:3] + parent.origin), ratio
