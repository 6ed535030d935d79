"""Robust geometric fit of concentric spheres.

Along unobservable directions the center is equal to its start value. `evaluate_sphere` checks
whether a fit is accepted.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, exp, pi, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jointfit_daemon.center_of_rotation._path_statistics import (
    arc_of,
    lag_one_correlation,
    radial_residuals,
)
from jointfit_daemon.center_of_rotation._result import CenterEstimate, refusal
from jointfit_daemon.center_of_rotation.spatial._observability import MIN_CONDITIONING, SphereLimits
from jointfit_daemon.center_of_rotation.spatial._sphere_estimate import STRAIGHT, objection

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

Mask = NDArray[np.bool_]

HUBER = 1.5
NOISE_FACTOR = 6.0
"""Ratio of the mean square rotation of the markers in a direction to the mean square rotation that
noise causes. Above this ratio the direction is observed.
"""
_PASSES = 30
_ROUNDED = 1e-9
_LONGEST_STEP_M = 0.2


@dataclass(frozen=True, slots=True)
class SphereOptions:
    """Settings of a geometric sphere fit."""

    huber: float = HUBER
    """Residual, in robust standard deviations, above which the weight of a point is reduced; inf
    for plain least squares.
    """
    smallest_scale: float = _ROUNDED
    """Smallest residual scale, m. With soft-tissue artefact use 0.1 mm, so that a few frames with
    small residuals do not dominate."""
    start: Array | None = None
    """Initial center, m, shape (3,). The estimate keeps this value along unobserved directions."""
    hold: float = 0.0
    """Noise of the markers, m. Along directions in which this noise exceeds the movement, the
    iteration starts at `start`.
    """
    min_direction: float = 0.0
    """RMS rotation, rad, below which a direction counts as unobserved even with small noise."""
    keep_one: bool = False
    """Whether to fit at least the direction with the largest rotation, even if it is unobservable.
    """


@dataclass(frozen=True, slots=True)
class SphereFit:
    """Geometric fit with the statistics for its acceptance."""

    center: Array
    """Position of the center, m, shape (3,)."""
    basis: Array
    """Observed directions as columns, shape (3, r)."""
    residuals: Array
    """Radial residuals, m, shape (n, k); zero where missing."""
    seen: Mask
    weights: Array
    """Huber weights of the points, shape (n, k); zero where a point is missing."""
    turning: Array
    """Derivatives of the residuals with respect to the center, shape (n, k, 3)."""
    radii: Array
    """Mean distance of each marker, m, shape (k,)."""
    resultant: Array
    """Mean direction of each marker from the center, shape (k, 3)."""

    @property
    def information(self) -> Array:
        """Return JᵀWJ in the observed directions, shape (r, r)."""
        J = self.turning @ self.basis
        return np.asarray(np.einsum("tj,tja,tjb->ab", self.weights, J, J))

    @property
    def unseen(self) -> Array:
        """Return the unobserved directions as rows, shape (3 - r, 3)."""
        return np.asarray(np.linalg.svd(self.basis)[0][:, self.basis.shape[1] :].T)


def solve_sphere(points: Array, options: SphereOptions) -> SphereFit:
    """Fit spheres about one center by Gauss-Newton with Huber weights; radii are eliminated.

    Along unobserved directions the center is equal to its start value. Without this rule, noise
    would move the center to the plane of the markers, and the covariance of the center would be too
    small. Source: Halvorsen 2003; Chang and Pollard 2007.

    Parameters
    ----------
    points : ndarray, shape (n, k, 3)
        Marker positions, m; NaN where missing. Every marker must be visible at least twice.
    options : SphereOptions
        Start value of the center, the Huber threshold and the limits of observability.
    """
    seen = np.asarray(np.isfinite(points).all(axis=-1))
    v = np.where(seen[..., None], points, 0.0)
    w = seen.astype(np.float64)
    start = v.sum(axis=(0, 1)) / w.sum() if options.start is None else options.start
    start = np.asarray(start, dtype=np.float64)
    m = _begin(v, w, start, options)
    basis: Array = np.eye(3)

    for _ in range(_PASSES):
        e, _ = radial_residuals(v, m, w)
        scale = max(1.4826 * float(np.median(np.abs(e[seen]))), options.smallest_scale)
        huber = np.minimum(1.0, options.huber * scale / np.maximum(np.abs(e), 1e-12))
        w = np.where(seen, huber, 0.0)
        e, J = radial_residuals(v, m, w)
        basis = _observed_basis(v, w, m, scale, options)
        if basis.shape[1] == 0:
            break
        Jb = J @ basis
        H = np.einsum("tj,tja,tjb->ab", w, Jb, Jb)
        if not np.trace(H) > 0.0:  # no marker moved
            basis = np.zeros((3, 0))
            break

        g = np.einsum("tj,tja,tj->a", w, Jb, e)
        # far from the solution the radii are wrong, and full steps overshoot
        step = basis @ np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(len(H)), -g)
        step *= min(1.0, _LONGEST_STEP_M / max(float(np.linalg.norm(step)), 1e-12))
        m = start + basis @ (basis.T @ (m + step - start))
        if np.linalg.norm(step) < 1e-9:
            break

    e, J = radial_residuals(v, m, w)
    u = np.linalg.norm(v - m, axis=-1)
    total = np.maximum(w.sum(axis=0), 1e-12)
    resultant = np.einsum("tj,tja->ja", w, (v - m) / np.maximum(u, 1e-9)[..., None])
    return SphereFit(
        center=m,
        basis=basis,
        residuals=np.where(seen, e, 0.0),
        seen=seen,
        weights=w,
        turning=J,
        radii=(w * u).sum(axis=0) / total,
        resultant=resultant / total[:, None],
    )


def _begin(v: Array, w: Array, start: Array, options: SphereOptions) -> Array:
    """Return the center of Gamage and Lasenby as the initial center of the iteration.

    Along directions in which the noise `hold` exceeds the movement, the result is close to `start`.
    """
    total = np.maximum(w.sum(axis=0), 1e-12)
    d = v - start
    d = d - (w[..., None] * d).sum(axis=0) / total[:, None]
    square = ((v - start) ** 2).sum(axis=-1)
    square = square - (w * square).sum(axis=0) / total
    A = 2.0 * np.einsum("tj,tja,tjb->ab", w / total, d, d)
    b = np.einsum("tj,tja,tj->a", w / total, d, square)

    # a millionth of the path's moment avoids a singular matrix for motion in a plane
    least = max(options.hold**2, 1e-6 * float(np.trace(A)) / len(total))
    return np.asarray(start + np.linalg.solve(A + 2.0 * len(total) * least * np.eye(3), b))


def _observed_basis(v: Array, w: Array, m: Array, scale: float, options: SphereOptions) -> Array:
    """Return an orthonormal basis (3, r) of the observed directions.

    Noise changes the unit vector u from the center to a marker only perpendicular to u. The
    threshold along each axis b of the basis is therefore multiplied by the mean of 1 - (b·u)² over
    all markers.
    """
    _, J = radial_residuals(v, m, w)
    total = w.sum()
    spread, axes = np.linalg.eigh(np.einsum("tj,tja,tjb->ab", w, J, J) / total)
    d = v - m
    u2 = np.maximum((d**2).sum(axis=-1), 1e-4)
    along = np.einsum("tj,tja,tjb->ab", w / u2, d, d) / total
    across = np.maximum(1.0 - np.einsum("ai,ab,bi->i", axes, along, axes), 0.0)
    noise = scale**2 * float((w / u2).sum() / total)
    if options.keep_one:
        # This option is for skin markers. Its threshold is a fixed multiple of the noise.
        keep = spread >= max(options.min_direction**2, NOISE_FACTOR * noise) * across
        keep[-1] = True
        return np.asarray(axes[:, keep])

    left = spread - noise * across
    chance = np.array([7.0, 0.0, 0.0]) * noise * np.sqrt(2.0 / total) * across
    sharp = MIN_CONDITIONING**2 * noise / total
    third = np.array([options.min_direction**2, 0.0, 0.0])
    keep = left > np.maximum(np.maximum(third, chance), sharp)

    return np.asarray(axes[:, keep])


def evaluate_sphere(
    fit: SphereFit, method: str, frames: int, limits: SphereLimits, options: SphereOptions
) -> CenterEstimate:
    r"""Return the estimate of a fit with its covariance, or a refused estimate.

    .. math:: C = \frac{\sum ψ^2 / (N - k - r)}{p^2} \Big(\sum J J^T - \text{contribution of noise}
              \Big)^{-1} \frac{1+\rho}{1-\rho}

    where ψ are the residuals limited to the Huber threshold, p is the fraction of residuals that
    are not limited, and ρ is the correlation of the residuals from one frame to the next (Huber
    1964). N is the number of residuals, k the number of markers, r the number of observed
    directions, J the derivatives of the residuals. The factor with ρ prevents an underestimate of
    the covariance for smooth disturbances at a high frame rate.
    """
    n, k = int(fit.seen.sum()), fit.seen.shape[1]
    rank = fit.basis.shape[1]
    if rank == 0 or (rank == 1 and not options.keep_one):
        return refusal(method, 3, frames, STRAIGHT)
    free = max(n - k - rank, 1)
    cut = fit.weights * fit.residuals
    share = float(np.count_nonzero(fit.weights[fit.seen] >= 1.0 - 1e-12)) / n
    psi2 = max(float((cut**2).sum()) / free, 1e-18)
    noise2 = psi2 / kept_by_huber(options.huber)
    rho = lag_one_correlation(fit.residuals, fit.seen)
    J = fit.turning @ fit.basis
    H = np.einsum("tj,tja,tjb->ab", fit.seen.astype(np.float64), J, J)
    per_turn = fit.seen.sum(axis=0) * noise2 / np.maximum(fit.radii, 1e-3) ** 2
    across = np.eye(rank) * per_turn.sum() - np.einsum(
        "j,ja,jb->ab", per_turn, fit.resultant @ fit.basis, fit.resultant @ fit.basis
    )
    exact = H - across
    H = exact if np.linalg.eigvalsh(exact)[0] > 0.1 * np.linalg.eigvalsh(H)[0] else H
    bread = np.linalg.inv(H)
    shown = bread * psi2 / max(share, 0.25) ** 2 * (1.0 + rho) / (1.0 - rho)
    radius = float(np.median(fit.radii))
    conditioning = radius / float(np.sqrt(np.linalg.norm(shown, 2)))
    unseen = fit.unseen

    # The marker whose direction changed most determines the arc. The directions of markers near the
    # axis change less.
    inside = np.linalg.norm(fit.resultant @ fit.basis, axis=1)
    off = np.linalg.norm(fit.resultant @ unseen.T, axis=1) if len(unseen) else 0.0 * inside
    arc = arc_of(float((inside / np.sqrt(np.maximum(1.0 - off**2, 1e-12))).min()))
    return CenterEstimate(
        method=method,
        center=fit.center,
        covariance=fit.basis @ shown @ fit.basis.T,
        noise=float(np.sqrt(noise2)),
        residual=float(np.sqrt((fit.residuals[fit.seen] ** 2).mean())),
        radii=fit.radii,
        arc=arc,
        bound=float(np.sqrt(np.trace(bread) * noise2)) if rank == 3 else np.inf,
        conditioning=conditioning,
        frames=frames,
        effective_frames=frames * (1.0 - rho) / (1.0 + rho),
        unseen=unseen,
        axis=unseen[0] if rank == 2 else None,
        flags=(("hinge",) if rank == 2 else ()) + (("residuals_persist",) if rho > 0.5 else ()),
        refused=objection(arc, radius, conditioning, limits),
    )


def kept_by_huber(k: float) -> float:
    """Return the variance of a standard normal residual limited to ±k."""
    if not np.isfinite(k):
        return 1.0
    inside = erf(k / sqrt(2.0))
    return inside - 2.0 * k * exp(-k * k / 2.0) / sqrt(2.0 * pi) + k * k * (1.0 - inside)
