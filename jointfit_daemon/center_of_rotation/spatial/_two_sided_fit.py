r"""Center of two bodies whose poses are fitted to noisy markers.

Noise of the markers rotates the fitted bodies, and moves a point in proportion to its distance from
the markers. SCoRE, a least-squares fit of the gap between the points of both bodies, is therefore
biased towards the markers. The bias is some millimeters in small movements. The fit of this module
estimates the errors of both rotations in every frame together with the center (errors in
variables).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation._movement import BodyPoses


HUBER = 1.5
"""Half the length of the gap, in standard deviations of a coordinate, above which the weight of a
frame is reduced.
"""
MEDIAN_LENGTH = 1.538
"""Median length of a vector of three standard normal components."""
_PASSES = 40
_CONVERGED_M = 1e-6
_SAME_WEIGHT = 1e-3
_LEAST_M = 1e-9
_GENERATORS = rotation.skew(np.eye(3))


@dataclass(frozen=True, slots=True)
class ClusterNoise:
    r"""Error of a pose fitted to k markers, for unit variance of their coordinates.

    .. math:: \mathrm{Cov}(\varphi) = G^{-1}, \quad \mathrm{Cov}(\bar y) = \tfrac1k I, \quad
              G = \sum_j \left(|d_j|^2 I - d_j d_j^T\right)

    φ is the rotation error about the mean ȳ of the markers, and d_j the vector from this mean to
    marker j.
    """

    middle: Array
    """Mean of the markers in body coordinates, m, shape (3,)."""
    turning: Array
    """Covariance G⁻¹ of the rotation error, 1/m², shape (3, 3)."""
    shift: float
    """Variance of the mean of the markers, 1/k."""

    @classmethod
    def of(cls, markers: Array) -> ClusterNoise:
        """Return the pose errors of a fit to markers, m, shape (k, 3), that are not on a line."""
        middle = markers.mean(axis=0)
        d = markers - middle
        G = np.trace(d.T @ d) * np.eye(3) - d.T @ d
        return cls(middle, np.linalg.inv(G), 1.0 / len(markers))


@dataclass(frozen=True, slots=True)
class TwoSidedFit:
    """Points of both bodies that coincide, with the statistics of their error."""

    point: Array
    """Point in parent and in child coordinates, m, shape (6,)."""
    gaps: Array
    """Gap in each frame divided by the standard deviation that unit noise causes, m, shape (n, 3).
    """
    weights: Array
    """Weight of each frame, shape (n,)."""
    residual: float
    """RMS distance between the points of both bodies, m."""
    score: Array
    """Variance of the estimating equations for unit noise, along the basis, shape (r, r)."""
    information: Array
    """Derivative of the estimating equations, shape (r, r). Without noise in the rotations this
    derivative is the inverse covariance.
    """

    def spread(self) -> Array | None:
        r"""Return the covariance along the basis per noise variance, :math:`M^{-1} S M^{-1}`.

        S is `score`, M is `information`. The result is None if the rotations are no larger than the
        rotation noise, so that M is not positive definite.
        """
        values, axes = np.linalg.eigh(self.information)
        if values[0] <= 1e-9 * values[-1]:
            return None
        inverse = (axes / values) @ axes.T
        return np.asarray(inverse @ self.score @ inverse)


def fit_two_sides(
    poses: tuple[BodyPoses, BodyPoses],
    noise: tuple[ClusterNoise, ClusterNoise],
    start: Array,
    basis: Array,
    *,
    robust: bool,
) -> TwoSidedFit:
    r"""Fit the points of two bodies that coincide in every frame, by the Gauss-Helmert method.

    .. math:: \min \sum_t \sum_{i=1,2} \left( k_i |\rho_{it}|^2 + \varphi_{it}^T G_i \varphi_{it}
              \right) \quad \text{subject to} \quad
              R_1 e^{[\varphi_1]} \lambda_1 + p_1 + \rho_1 = R_2 e^{[\varphi_2]} \lambda_2 + p_2
              + \rho_2

    where λ is the point relative to the mean of a body's markers, p the measured mean, and k the
    number of markers. φ and ρ are the errors of rotation and position of the pose. G is defined in
    `ClusterNoise`. To first order this is the maximum-likelihood estimate for isotropic marker
    noise of any variance. Rotation errors of a distant cluster cause only gaps perpendicular to the
    line to the cluster. Such gaps have less weight than gaps along the line.

    Parameters
    ----------
    poses : tuple of BodyPoses
        Poses of parent and child in the same world coordinates, without NaN, n frames.
    noise : tuple of ClusterNoise
        Pose errors of parent and child.
    start : ndarray, shape (6,)
        Initial point in parent and child coordinates, m.
    basis : ndarray, shape (6, r)
        Directions in which the point is fitted, orthonormal columns.
    robust : bool
        Whether to apply Huber weights to the gaps.
    """
    (parent, child), (above, below) = poses, noise
    R1 = rotation.to_matrix(parent.q)
    Q = np.swapaxes(R1, 1, 2) @ rotation.to_matrix(child.q)
    apart = parent.to_world(above.middle) - child.to_world(below.middle)
    p = np.einsum("tji,tj->ti", R1, apart)
    middles = np.concatenate((above.middle, below.middle))
    lever, turned, w = start - middles, (np.zeros_like(p), np.zeros_like(p)), np.ones(len(Q))

    for _ in range(_PASSES):
        # take a step of the point, then compute the rotations that close the remaining gap
        frames = _linearize((Q, p), noise, turned, lever)
        step, gap, _ = _step(frames, basis, w)
        force = _apply(frames.V, gap)
        turned = -_apply(frames.gains[0], force), -_apply(frames.gains[1], force)
        lever = lever + basis @ step

        before = w
        if robust:
            w = huber_weights(np.sqrt(np.maximum((gap * force).sum(axis=1), 0.0)))
        settled = float(np.abs(w - before).max()) < _SAME_WEIGHT
        if settled and float(np.abs(step).max()) < _CONVERGED_M:
            break

    frames = _linearize((Q, p), noise, turned, lever)
    step, gap, S = _step(frames, basis, w)
    lever = lever + basis @ step
    white = np.einsum("tba,tb->ta", np.linalg.cholesky(frames.V), gap)
    noise2 = float((w[:, None] * white**2).sum()) / max(3.0 * len(w) - len(S), 1.0)
    M = S - noise2 * basis.T @ _remaining_noise(frames, w, noise) @ basis
    apart = lever[:3] + p - Q @ lever[3:]
    return TwoSidedFit(
        point=lever + middles,
        gaps=white,
        weights=w,
        residual=float(np.sqrt((apart**2).sum(axis=1).mean())),
        score=S,
        information=(M + M.T) / 2.0,
    )


@dataclass(frozen=True, slots=True)
class _LinearGaps:
    """Gaps in parent coordinates, linear in the point and in the errors of both rotations."""

    turns: tuple[Array, Array]
    """Rotations of parent and child after correction, shape (n, 3, 3) each."""
    gains: tuple[Array, Array]
    """Covariance of each rotation error with the gap, for unit noise, shape (n, 3, 3) each."""
    V: Array
    """Inverse covariance of the gap for unit noise, (n, 3, 3)."""
    A: Array
    """Derivative of the gap with respect to the point, (n, 3, 6)."""
    gap: Array
    """Gap before the correction of the rotations, m, (n, 3)."""


def _linearize(
    measured: tuple[Array, Array],
    noise: tuple[ClusterNoise, ClusterNoise],
    turned: tuple[Array, Array],
    lever: Array,
) -> _LinearGaps:
    """Return the gaps, linearized at the point `lever` and the rotations corrected by `turned`."""
    (Q, p), (above, below) = measured, noise
    E1 = rotation.to_matrix(rotation.exp(turned[0]))
    E2 = Q @ rotation.to_matrix(rotation.exp(turned[1]))
    J1, J2 = -E1 @ rotation.skew(lever[:3]), E2 @ rotation.skew(lever[3:])
    K1, K2 = above.turning @ np.swapaxes(J1, 1, 2), below.turning @ np.swapaxes(J2, 1, 2)
    V = np.linalg.inv(J1 @ K1 + J2 @ K2 + (above.shift + below.shift) * np.eye(3))
    gap = E1 @ lever[:3] + p - E2 @ lever[3:] - _apply(J1, turned[0]) - _apply(J2, turned[1])
    A = np.concatenate((E1, -E2), axis=2)
    return _LinearGaps((E1, E2), (K1, K2), np.asarray(V), A, gap)


def _step(frames: _LinearGaps, basis: Array, w: Array) -> tuple[Array, Array, Array]:
    """Return the step of the point (r,), the gaps after the step (n, 3), and AᵀVA (r, r)."""
    A = frames.A @ basis
    weighted = w[:, None, None] * np.swapaxes(A, 1, 2) @ frames.V
    S = (weighted @ A).sum(axis=0)
    step = -np.linalg.lstsq(S, _apply(weighted, frames.gap).sum(axis=0), rcond=1e-12)[0]
    return step, frames.gap + A @ step, S


def huber_weights(size: Array) -> Array:
    """Return the Huber weight of each frame from the length `size` of its gap, shape (n,)."""
    scale = max(float(np.median(size)) / MEDIAN_LENGTH, _LEAST_M)
    return np.asarray(np.minimum(1.0, 2.0 * HUBER * scale / np.maximum(size, 1e-300)))


def _apply(matrices: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("tab,tb->ta", matrices, vectors))


def _remaining_noise(
    frames: _LinearGaps, w: Array, noise: tuple[ClusterNoise, ClusterNoise]
) -> Array:
    r"""Return the part of the score S that errors of the corrected rotations cause, shape (6, 6).

    .. math:: \sum_t w_t\, E\left[ δA^T V δA \right], \qquad
              δA = (E_1 [δφ_1]_×, \; -E_2 [δφ_2]_×), \qquad
              \mathrm{Cov}(δφ) = \mathrm{diag}(G_i^{-1}) - K V K^T

    for unit noise variance. A is the derivative of the gap with respect to the point, V the inverse
    covariance of the gap, and w the weight of frame t. Cov(δφ) is the covariance of the rotations
    after the correction by the gap.
    """
    out = np.zeros((6, 6))
    for i in (0, 1):
        for j in (0, 1):
            P = -frames.gains[i] @ frames.V @ np.swapaxes(frames.gains[j], 1, 2)
            P = P + noise[i].turning if i == j else -P
            inner = w[:, None, None] * np.swapaxes(frames.turns[i], 1, 2) @ frames.V
            block = np.einsum("tcd,tbe->cdbe", P, inner @ frames.turns[j])
            out[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = np.einsum(
                "cba,cdbe,def->af", _GENERATORS, block, _GENERATORS
            )
    return out
