"""Center of rotation from the poses of two bodies (SCoRE), or the axis of a hinge.

The method finds the point of the parent and the point of the child that coincide in every frame.
Both poses may be noisy. The singular values of N = [R₁, -R₂] distinguish a point from an axis.
"""

from __future__ import annotations

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
SEVERAL_AXES = (
    "the joint turned about more than one axis (σ₆/σ₅ {:.2f}, a hinge has less than "
    f"{HINGE_RATIO}): use score or sphere, or move about one axis only"
)
NO_TURN = "the child did not rotate against the parent: move the joint, at least 30° each way"
MIN_TURN_RAD = 0.02
"""RMS rotation, rad, about the second axis of the movement below which there was no rotation."""
LEVER_M = 0.24
"""Replaces the radius in T, m, since poses carry no marker positions: the center must be known to
40 mm."""
HUBER = 1.5
_PASSES = 10
_LEAST_M = 1e-9


def fit_score(
    parent: BodyPoses, child: BodyPoses, *, near: Array | None = None, robust: bool = True
) -> CenterEstimate:
    """Estimate a center by SCoRE; if only an axis was observed, return the estimate of a hinge.

    Ehrig et al. 2006. Parameters as in `two_sided_estimate`.
    """
    return two_sided_estimate("score", parent, child, near, hinge=False, robust=robust)


def two_sided_estimate(
    name: str, parent: BodyPoses, child: BodyPoses, near: Array | None, *, hinge: bool, robust: bool
) -> CenterEstimate:
    r"""Estimate the point, or the axis, that coincides in both bodies.

    .. math:: \min \sum_t \rho\left(|R_1 c_1 + t_1 - R_2 c_2 - t_2|\right)

    Parameters
    ----------
    name : str
        Name of the estimator.
    parent, child : BodyPoses
        In one world; frames with NaN are left out.
    near : ndarray, shape (3,), or None
        Position along a hinge's axis, in the parent's coordinates, m; None: nearest the parent's
        origin.
    hinge : bool
        Solve for an axis, without the sixth singular value. False: only if the ratio of the last
        two is below `HINGE_RATIO`.
    robust : bool
        Huber weights on the gap, which reduce the influence of marker swaps.

    Returns
    -------
    CenterEstimate
        In the parent's coordinates; `residual` is the RMS gap between the two sides.
    """
    good = np.isfinite(parent.q).all(1) & np.isfinite(child.q).all(1)
    good &= np.isfinite(parent.t).all(1) & np.isfinite(child.t).all(1)
    n = int(np.count_nonzero(good))
    if n < MIN_FRAMES:
        return refusal(name, 3, 0, FEW)

    R1, R2 = rotation.to_matrix(parent.q[good]), rotation.to_matrix(child.q[good])
    N = np.concatenate((R1, -R2), axis=2)
    rhs = child.t[good] - parent.t[good]
    w = _huber_weights(N, rhs, hinge=hinge) if robust else np.ones(n)
    c, gaps, s, Vt, rank = _solve(N, rhs, w, hinge=hinge)

    # RMS turning about the second axis of the movement, rad
    ratio, turn = float(s[5] / max(s[4], 1e-300)), float(s[4]) / sqrt(float(w.sum()))
    if turn < MIN_TURN_RAD:
        return refusal(name, 3, n, NO_TURN)
    if hinge and ratio >= HINGE_RATIO:
        return refusal(name, 3, n, SEVERAL_AXES.format(ratio))

    inverse = (Vt[:rank].T / np.maximum(s[:rank], 1e-12) ** 2) @ Vt[:rank]
    white, C, rho = _covariances(gaps, w, inverse, rank)

    # the direction along the axis is unobserved
    axis = Vt[5, :3] / np.linalg.norm(Vt[5, :3]) if rank == 5 else None
    center = c[:3]
    if axis is not None:
        P = np.eye(3) - np.outer(axis, axis)
        along = 0.0 if near is None else float(axis @ (near - center))
        center, C = center + along * axis, P @ C @ P

    arc = _arc(parent, child)
    conditioning = LEVER_M / sqrt(max(float(np.linalg.eigvalsh(C)[-1]), 1e-18))
    return CenterEstimate(
        method=name,
        center=center,
        covariance=(C + C.T) / 2.0,
        noise=sqrt(float((gaps**2).mean())),
        residual=sqrt(float((gaps**2).sum(axis=1).mean())),
        radii=np.array([float(np.linalg.norm(c[3:]))]),
        arc=arc,
        bound=inf if rank == 5 else sqrt(float(np.trace(white))),
        conditioning=conditioning,
        frames=n,
        effective_frames=n * (1.0 - rho) / (1.0 + rho),
        unseen=np.zeros((0, 3)) if axis is None else axis[None],
        axis=axis,
        flags=("hinge",) if rank == 5 else (),
        within95=within95(rank - 3, 3.0 * n * (1 - rho) / (1 + rho) - 6.0),
        refused=objection(arc, LEVER_M, conditioning, SphereLimits()),
    )


def _covariances(gaps: Array, w: Array, inverse: Array, rank: int) -> tuple[Array, Array, float]:
    """Return the covariance of the parent's point for white noise and in total, m², shape (3, 3).

    The third value is the correlation of the gaps from one frame to the next. Persistent noise
    reduces the effective frames; with soft-tissue artefact a single one remains.
    """
    n = len(gaps)
    noise2 = max(float((w[:, None] * gaps**2).sum()) / max(3.0 * n - rank, 1.0), _LEAST_M**2)
    soft_tissue2 = noise2 * float(w.sum()) * posture_share(_correlation(gaps, LAGS[1]), n)
    rho = _correlation(gaps, LAGS[0])
    rho = min(rho, 0.99) if rho > 2.0 / sqrt(gaps.size) else 0.0

    white = noise2 * inverse
    total = white * (1.0 + rho) / (1.0 - rho) + soft_tissue2 * inverse
    return white[:3, :3], total[:3, :3], rho


def _arc(parent: BodyPoses, child: BodyPoses) -> float:
    """Return the arc of the direction that rotated most, rad."""
    q = rotation.multiply(rotation.conjugate(parent.q), child.q)
    R = rotation.to_matrix(q[np.isfinite(q).all(axis=1)])
    # the length of the mean of that direction is its resultant
    return arc_of(float(np.linalg.svd(R.mean(axis=0))[1][2]))


def _huber_weights(N: Array, rhs: Array, *, hinge: bool) -> Array:
    """Return the weight of each frame, shape (n,)."""
    w = np.ones(len(N))
    for _ in range(_PASSES):
        size = np.linalg.norm(_solve(N, rhs, w, hinge=hinge)[1], axis=1)
        # the median length of three normal components is 1.538 of each
        scale = max(float(np.median(size)) / 1.538, _LEAST_M)
        again = np.minimum(1.0, 2.0 * HUBER * scale / np.maximum(size, 1e-300))
        if np.allclose(again, w, rtol=0.0, atol=1e-6):
            break
        w = again
    return w


def _solve(
    N: Array, rhs: Array, w: Array, *, hinge: bool
) -> tuple[Array, Array, Array, Array, int]:
    """Return both points (6,), gaps (n, 3), singular values, right vectors and the rank used."""
    root = np.sqrt(w)[:, None]
    U, s, Vt = np.linalg.svd((root[..., None] * N).reshape(-1, 6), full_matrices=False)
    rank = 5 if hinge or s[5] < HINGE_RATIO * s[4] else 6
    shown = (U.T @ (root * rhs).reshape(-1))[:rank] / np.maximum(s[:rank], 1e-12)
    c = Vt[:rank].T @ shown
    return c, N @ c - rhs, s, Vt, rank


def _correlation(gaps: Array, lag: int) -> float:
    power = float((gaps**2).mean())
    return float((gaps[lag:] * gaps[:-lag]).mean()) / power if power > _LEAST_M**2 else 0.0
