"""Center of rotation from the poses of two bodies (SCoRE), or the axis of a hinge.

The method finds the point of the parent and the point of the child that coincide in every frame.
Both poses may be noisy. The singular values of N = [R₁, -R₂] distinguish a point from an axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation._path_statistics import arc_of
from jointfit_daemon.center_of_rotation._result import CenterEstimate, refusal
from jointfit_daemon.center_of_rotation.spatial._observability import (
    SphereLimits,
    posture_share,
    within95,
)
from jointfit_daemon.center_of_rotation.spatial._sphere_estimate import objection
from jointfit_daemon.center_of_rotation.spatial._sphere_sums import LAGS
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation._movement import BodyPoses


HINGE_RATIO = 0.3
"""σ₆/σ₅ below which only an axis was observed (hips in squats 0.07 to 0.35; a ball joint moved in
all directions 0.85 and more)."""
MIN_FRAMES = 15
FEW = f"fewer than {MIN_FRAMES} frames show both bodies: keep three markers of each body visible"
MIN_TURN_RAD = 0.02
"""RMS turning about the second axis of the movement below which nothing was turned."""
LEVER_M = 0.24
"""Replaces the radius in T, m, since poses carry no marker positions: the center must be known to
40 mm."""
HUBER = 1.5
_PASSES = 10
_LEAST_M = 1e-9


@dataclass(frozen=True, slots=True)
class TwoSidedSolution:
    """Common point or axis of two bodies."""

    parent_point: Array
    """m, in the parent, shape (3,); along an axis the point nearest both origins."""
    child_point: Array
    """m, in the child, shape (3,)."""
    parent_axis: Array
    """Unit, the direction least seen, in the parent, shape (3,)."""
    hinge: bool
    """Solved for an axis."""
    ratio: float
    """σ₆/σ₅."""
    turn: float
    """σ₅ per frame: RMS turning about the second axis of the movement, rad."""
    gaps: Array
    """Distance vectors between the two sides, m, shape (n, 3)."""
    covariance: Array
    """Covariance of parent and child point for white noise, m², shape (6, 6), zero along the
    axis."""
    soft_tissue: Array
    """Additional covariance of the soft-tissue artefact, m², shape (6, 6)."""
    persistence: float
    """Correlation of the gaps from one frame to the next, 0 to 0.99."""
    frames: int


def solve_two_sided(
    parent: BodyPoses, child: BodyPoses, *, hinge: bool | None = None, robust: bool = True
) -> TwoSidedSolution | None:
    r"""Solve for the point that coincides in both bodies.

    .. math:: \min \sum_t \rho\left(|R_1 c_1 + t_1 - R_2 c_2 - t_2|\right)

    Parameters
    ----------
    parent, child : BodyPoses
        In one world; frames with NaN are left out.
    hinge : bool, optional
        Leave out the sixth singular value; None: if the ratio is below `HINGE_RATIO`.
    robust : bool
        Huber weights on the gap, by which marker swaps lose their weight.

    Returns
    -------
    TwoSidedSolution or None
        None with fewer than `MIN_FRAMES` frames.
    """
    good = np.isfinite(parent.q).all(1) & np.isfinite(child.q).all(1)
    good &= np.isfinite(parent.t).all(1) & np.isfinite(child.t).all(1)
    n = int(np.count_nonzero(good))
    if n < MIN_FRAMES:
        return None
    R1, R2 = rotation.to_matrix(parent.q[good]), rotation.to_matrix(child.q[good])
    N = np.concatenate((R1, -R2), axis=2)
    rhs = child.t[good] - parent.t[good]
    w = np.ones(n)

    for _ in range(_PASSES if robust else 0):
        size = np.linalg.norm(_solve(N, rhs, w, hinge)[1], axis=1)
        # the median length of three normal components is 1.538 of each
        scale = max(float(np.median(size)) / 1.538, _LEAST_M)
        again = np.minimum(1.0, 2.0 * HUBER * scale / np.maximum(size, 1e-300))
        if np.allclose(again, w, rtol=0.0, atol=1e-6):
            break
        w = again

    c, gaps, s, Vt, rank = _solve(N, rhs, w, hinge)
    noise2 = max(float((w[:, None] * gaps**2).sum()) / max(3.0 * n - rank, 1.0), _LEAST_M**2)
    inverse = (Vt[:rank].T / np.maximum(s[:rank], 1e-12) ** 2) @ Vt[:rank]
    soft_tissue2 = noise2 * float(w.sum()) * posture_share(_correlation(gaps, LAGS[1]), n)
    rho = _correlation(gaps, LAGS[0])

    return TwoSidedSolution(
        parent_point=c[:3],
        child_point=c[3:],
        parent_axis=Vt[5, :3] / np.linalg.norm(Vt[5, :3]),
        hinge=rank == 5,
        ratio=float(s[5] / max(s[4], 1e-300)),
        turn=float(s[4]) / sqrt(float(w.sum())),
        gaps=gaps,
        covariance=noise2 * inverse,
        soft_tissue=soft_tissue2 * inverse,
        persistence=min(rho, 0.99) if rho > 2.0 / sqrt(gaps.size) else 0.0,
        frames=n,
    )


def _solve(
    N: Array, rhs: Array, w: Array, hinge: bool | None
) -> tuple[Array, Array, Array, Array, int]:
    """Return both points (6,), gaps (n, 3), singular values, right vectors and the rank used."""
    root = np.sqrt(w)[:, None]
    U, s, Vt = np.linalg.svd((root[..., None] * N).reshape(-1, 6), full_matrices=False)
    only_axis = s[5] < HINGE_RATIO * s[4] if hinge is None else hinge
    rank = 5 if only_axis else 6
    shown = (U.T @ (root * rhs).reshape(-1))[:rank] / np.maximum(s[:rank], 1e-12)
    c = Vt[:rank].T @ shown
    return c, N @ c - rhs, s, Vt, rank


def _correlation(gaps: Array, lag: int) -> float:
    power = float((gaps**2).mean())
    return float((gaps[lag:] * gaps[:-lag]).mean()) / power if power > _LEAST_M**2 else 0.0


def fit_score(
    parent: BodyPoses, child: BodyPoses, *, near: Array | None = None, robust: bool = True
) -> CenterEstimate:
    """Estimate a center by SCoRE; where only an axis was observed the answer is a hinge's.

    Ehrig et al. 2006. Coordinates are the parent's.

    Parameters
    ----------
    parent, child : BodyPoses
        In one world.
    near : ndarray, shape (3,), optional
        Where to come to along a hinge's axis, m; None: nearest the parent's origin.
    robust : bool
        Huber weights on the gap.

    Returns
    -------
    CenterEstimate
        `residual` is the RMS gap between the two sides.
    """
    found = solve_two_sided(parent, child, robust=robust)
    if found is None:
        return refusal("score", 3, 0, FEW)
    return two_sided_estimate(found, child, parent, "score", near)


def two_sided_estimate(
    found: TwoSidedSolution, child: BodyPoses, parent: BodyPoses, method: str, near: Array | None
) -> CenterEstimate:
    """Write a two-sided solution as an estimate; a hinge if it was solved as one."""
    if found.turn < MIN_TURN_RAD:
        return refusal(
            method,
            3,
            found.frames,
            "the child did not rotate against the parent: move the joint, at least 30° each way",
        )

    a = found.parent_axis
    rho = found.persistence

    # persistent noise reduces the effective frames; soft-tissue artefact leaves one
    total = found.covariance * (1.0 + rho) / (1.0 - rho) + found.soft_tissue
    center, C = found.parent_point, total[:3, :3]
    hinge = found.hinge
    unseen = a[None] if hinge else np.zeros((0, 3))
    if hinge:
        P = np.eye(3) - np.outer(a, a)
        along = 0.0 if near is None else float(a @ (near - center))
        center, C = center + along * a, P @ C @ P

    noise = sqrt(float((found.gaps**2).mean()))

    # the mean rotation shortens the direction that turned most to its resultant
    q = rotation.multiply(rotation.conjugate(parent.q), child.q)
    R = rotation.to_matrix(q[np.isfinite(q).all(axis=1)])
    arc = arc_of(float(np.linalg.svd(R.mean(axis=0))[1][2]))
    conditioning = LEVER_M / sqrt(max(float(np.linalg.eigvalsh(C)[-1]), 1e-18))
    return CenterEstimate(
        method=method,
        center=center,
        covariance=(C + C.T) / 2.0,
        noise=noise,
        residual=sqrt(float((found.gaps**2).sum(axis=1).mean())),
        radii=np.array([float(np.linalg.norm(found.child_point))]),
        arc=arc,
        bound=inf if hinge else sqrt(float(np.trace(found.covariance[:3, :3]))),
        conditioning=conditioning,
        frames=found.frames,
        effective_frames=found.frames * (1.0 - rho) / (1.0 + rho),
        unseen=unseen,
        axis=a if hinge else None,
        flags=("hinge",) if hinge else (),
        within95=within95(2 if hinge else 3, 3.0 * found.frames * (1 - rho) / (1 + rho) - 6.0),
        refused=objection(arc, LEVER_M, conditioning, SphereLimits()),
    )
