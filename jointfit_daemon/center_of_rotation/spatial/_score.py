"""Center of rotation from the poses of two bodies (SCoRE), or the axis of a hinge.

The method finds the point of the parent and the point of the child that coincide in every frame.
Both poses may be noisy. The matrix N = [R₁, -R₂] contains the rotations of both bodies in all
frames. Its singular values distinguish a point from an axis. If the markers of both bodies are
known, the noise of the markers is separated from the movement (`fit_two_sides`).
"""

from __future__ import annotations

from dataclasses import replace
from math import inf, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation._movement import BodyPoses
from jointfit_daemon.center_of_rotation._path_statistics import arc_of
from jointfit_daemon.center_of_rotation._result import CenterEstimate, refusal
from jointfit_daemon.center_of_rotation.spatial._observability import (
    SphereLimits,
    posture_share,
    within95,
)
from jointfit_daemon.center_of_rotation.spatial._sphere_estimate import PERSISTENT, objection
from jointfit_daemon.center_of_rotation.spatial._sphere_sums import LAGS
from jointfit_daemon.center_of_rotation.spatial._two_sided_fit import (
    ClusterNoise,
    TwoSidedFit,
    fit_two_sides,
    huber_weights,
)
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array


HINGE_RATIO = 0.3
"""Ratio σ₆/σ₅ of the two smallest singular values of N below which only an axis was observed. The
ratio is 0.07 to 0.35 for hips in squats, and at least 0.85 for a ball joint moved in all
directions.
"""
MIN_FRAMES = 15
FEW = f"fewer than {MIN_FRAMES} frames show both bodies: keep three markers of each body visible"
SEVERAL_AXES = (
    "the joint turned about more than one axis (σ₆/σ₅ {:.2f}, a hinge has less than "
    f"{HINGE_RATIO}): use score or sphere, or move about one axis only"
)
NO_TURN = "the child did not rotate relative to the parent: move the joint, at least 30° each way"
MIN_TURN_RAD = 0.02
"""RMS rotation about the second axis of the movement, rad, below which the movement counts as no
rotation."""
LEVER_M = 0.24
"""Length that replaces the radius in the conditioning T, m, because poses do not contain marker
positions. With this length T = 6 corresponds to a standard error of 40 mm.
"""
HIDDEN = (
    "noise of the markers rotates both bodies as much as the joint does: move the joint further, "
    "or put the markers of each body further apart"
)
_PASSES = 10
_LEAST_M = 1e-9


def fit_score(
    parent: BodyPoses,
    child: BodyPoses,
    *,
    near: Array | None = None,
    robust: bool = True,
    markers: tuple[Array, Array] | None = None,
    posture: bool = True,
) -> CenterEstimate:
    """Estimate a center by SCoRE, or a hinge if only an axis was observed.

    Source: Ehrig et al. 2006. The parameters have the same meaning as in `two_sided_estimate`.
    """
    return two_sided_estimate(
        "score", parent, child, near, hinge=False, robust=robust, markers=markers, posture=posture
    )


def two_sided_estimate(
    name: str,
    parent: BodyPoses,
    child: BodyPoses,
    near: Array | None,
    *,
    hinge: bool,
    robust: bool,
    markers: tuple[Array, Array] | None = None,
    posture: bool = True,
) -> CenterEstimate:
    r"""Estimate the point, or the axis, that coincides in both bodies.

    .. math:: \min \sum_t \rho\left(|R_1 c_1 + t_1 - R_2 c_2 - t_2|\right)

    R and t are rotation and translation of parent (1) and child (2), c is the point in each body,
    and ρ the Huber loss. If `markers` are given, this point is the start value of `fit_two_sides`.

    Parameters
    ----------
    name : str
        Name of the estimator.
    parent, child : BodyPoses
        Poses of both bodies in the same world coordinates; frames with NaN are ignored.
    near : ndarray, shape (3,), or None
        Point in the parent's coordinates, m. The center of a hinge is the point of the axis that is
        nearest to this point. None stands for the parent's origin.
    hinge : bool
        Whether to solve always for an axis, without the sixth singular value. If False, the result
        is an axis only if the ratio of the last two singular values is below `HINGE_RATIO`.
    robust : bool
        Whether to apply Huber weights to the gap between the points of both bodies. The weights
        reduce the influence of exchanged markers.
    markers : tuple of ndarray, shapes (m, 3) and (k, 3), or None
        Markers of parent and child to which the poses were fitted, each in the coordinates of its
        body, m. Each body needs at least three markers that are not on a line. If None, the noise
        of the poses is unknown. The center of a small movement is then biased, and its predicted
        error is too small.
    posture : bool
        Whether persistent residuals count as soft-tissue artefact. If False, the caller adds the
        variance of the artefact.

    Returns
    -------
    CenterEstimate
        Estimate in the parent's coordinates; `residual` is the RMS gap between the points of both
        bodies. `noise` is the standard deviation of a marker coordinate, or of a gap coordinate
        without `markers`.
    """
    good = np.isfinite(parent.q).all(1) & np.isfinite(child.q).all(1)
    good &= np.isfinite(parent.t).all(1) & np.isfinite(child.t).all(1)
    n = int(np.count_nonzero(good))
    if n < MIN_FRAMES:
        return refusal(name, 3, 0, FEW)

    poses = BodyPoses(parent.q[good], parent.t[good]), BodyPoses(child.q[good], child.t[good])
    R1, R2 = rotation.to_matrix(poses[0].q), rotation.to_matrix(poses[1].q)
    N, rhs = np.concatenate((R1, -R2), axis=2), poses[1].t - poses[0].t
    w = _huber_weights(N, rhs, hinge=hinge) if robust else np.ones(n)
    c, gaps, s, Vt, rank = _solve(N, rhs, w, hinge=hinge)

    # RMS rotation about the second axis of the movement, rad
    ratio, turn = float(s[5] / max(s[4], 1e-300)), float(s[4]) / sqrt(float(w.sum()))
    if turn < MIN_TURN_RAD:
        return refusal(name, 3, n, NO_TURN)
    if hinge and ratio >= HINGE_RATIO:
        return refusal(name, 3, n, SEVERAL_AXES.format(ratio))

    # If the gap has unit noise, score S and information M are both NᵀWN.
    squares = np.diag(s[:rank] ** 2)
    residual = sqrt(float((gaps**2).sum(axis=1).mean()))
    fit = TwoSidedFit(c, gaps, w, residual, squares, squares)
    if markers is not None:
        noise = ClusterNoise.of(markers[0]), ClusterNoise.of(markers[1])
        fit = fit_two_sides(poses, noise, c, Vt[:rank].T, robust=robust)

    # The arc is computed from the direction that rotated most, which has the shortest mean vector.
    R = rotation.to_matrix(rotation.multiply(rotation.conjugate(poses[0].q), poses[1].q))
    arc = arc_of(float(np.linalg.svd(R.mean(axis=0))[1][2]))
    found = _answer(name, fit, Vt, arc, near, posture=posture)
    if markers is None or not np.isfinite(found.center).all():
        return found

    # Distances of the markers from the center or, for a hinge, from the axis, m.
    away = markers[1] - fit.point[3:]
    axis = Vt[len(fit.score) :, 3:]
    along = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-300)
    return replace(found, radii=np.asarray(np.linalg.norm(away - away @ along.T @ along, axis=1)))


def _answer(
    name: str, fit: TwoSidedFit, Vt: Array, arc: float, near: Array | None, *, posture: bool
) -> CenterEstimate:
    """Return the estimate of a fit along the directions in the first rows of `Vt`."""
    n, rank = len(fit.gaps), len(fit.score)
    inner = fit.spread()
    if inner is None:
        return refusal(name, 3, n, HIDDEN)
    inverse = Vt[:rank].T @ inner @ Vt[:rank]
    white, C, rho, repeated = _covariances(fit, inverse, rank, posture=posture)

    # The rank 5 means a hinge, for which the direction along the axis is unobserved.
    axis = Vt[5, :3] / np.linalg.norm(Vt[5, :3]) if rank == 5 else None
    center = fit.point[:3]
    if axis is not None:
        P = np.eye(3) - np.outer(axis, axis)
        along = 0.0 if near is None else float(axis @ (near - center))
        center, C = center + along * axis, P @ C @ P

    conditioning = LEVER_M / sqrt(max(float(np.linalg.eigvalsh(C)[-1]), 1e-18))
    return CenterEstimate(
        method=name,
        center=center,
        covariance=(C + C.T) / 2.0,
        noise=sqrt(float((fit.gaps**2).mean())),
        residual=fit.residual,
        radii=np.array([float(np.linalg.norm(fit.point[3:]))]),
        arc=arc,
        bound=inf if rank == 5 else sqrt(float(np.trace(white))),
        conditioning=conditioning,
        frames=n,
        effective_frames=n * (1.0 - rho) / (1.0 + rho),
        unseen=np.zeros((0, 3)) if axis is None else axis[None],
        axis=axis,
        flags=(
            *(("hinge",) if rank == 5 else ()),
            *(("residuals_persist",) if rho > PERSISTENT else ()),
            *(("residuals_repeat",) if repeated > 0.0 else ()),
        ),
        within95=within95(rank - 3, 3.0 * n * (1 - rho) / (1 + rho) - 6.0),
        refused=objection(arc, LEVER_M, conditioning, SphereLimits()),
    )


def _covariances(
    fit: TwoSidedFit, inverse: Array, rank: int, *, posture: bool
) -> tuple[Array, Array, float, float]:
    """Return two covariances of the parent's point, m², a correlation and a fraction.

    The covariances are the covariance for white noise and the total covariance. The third value is
    the correlation of the gaps from one frame to the next, which reduces the effective number of
    frames. The fourth value is the fraction of the gap variance that repeats with posture. For this
    fraction all frames together count as one observation.
    """
    gaps, w = fit.gaps, fit.weights
    n = len(gaps)
    noise2 = max(float((w[:, None] * gaps**2).sum()) / max(3.0 * n - rank, 1.0), _LEAST_M**2)
    repeated = posture_share(_correlation(gaps, LAGS[1]), n) if posture else 0.0
    soft_tissue2 = noise2 * float(w.sum()) * repeated
    rho = _correlation(gaps, LAGS[0])
    rho = min(rho, 0.99) if rho > 2.0 / sqrt(gaps.size) else 0.0

    white = noise2 * inverse
    total = white * (1.0 + rho) / (1.0 - rho) + soft_tissue2 * inverse
    return white[:3, :3], total[:3, :3], rho, repeated


def _huber_weights(N: Array, rhs: Array, *, hinge: bool) -> Array:
    """Return the weight of each frame, shape (n,)."""
    w = np.ones(len(N))
    for _ in range(_PASSES):
        again = huber_weights(np.linalg.norm(_solve(N, rhs, w, hinge=hinge)[1], axis=1))
        if np.allclose(again, w, rtol=0.0, atol=1e-6):
            break
        w = again
    return w


def _solve(
    N: Array, rhs: Array, w: Array, *, hinge: bool
) -> tuple[Array, Array, Array, Array, int]:
    """Return points of both bodies (6,), gaps (n, 3), singular values, right vectors and rank."""
    root = np.sqrt(w)[:, None]
    U, s, Vt = np.linalg.svd((root[..., None] * N).reshape(-1, 6), full_matrices=False)
    rank = 5 if hinge or s[5] < HINGE_RATIO * s[4] else 6
    shown = (U.T @ (root * rhs).reshape(-1))[:rank] / np.maximum(s[:rank], 1e-12)
    c = Vt[:rank].T @ shown
    return c, N @ c - rhs, s, Vt, rank


def _correlation(gaps: Array, lag: int) -> float:
    power = float((gaps**2).mean())
    return float((gaps[lag:] * gaps[:-lag]).mean()) / power if power > _LEAST_M**2 else 0.0
