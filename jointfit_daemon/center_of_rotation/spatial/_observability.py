"""Observable directions of a center, and its covariance along them.

A direction is observable if two conditions hold. The markers rotated in this direction by more than
noise explains. The standard deviation of the center in this direction is below a sixth of the
radius. The covariance is increased for residuals that persist between frames and for noise that is
common to markers. Soft-tissue artefact repeats with posture, so all frames together count as one
observation of the artefact.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation.spatial._concentric_spheres import common_center
from jointfit_daemon.center_of_rotation.spatial._sphere_sums import LAGS

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation.spatial._concentric_spheres import (
        ConcentricSpheres,
        MarkerPaths,
    )
    from jointfit_daemon.center_of_rotation.spatial._sphere_sums import SphereSums


MIN_CONDITIONING = 6.0
"""Smallest T of an observed direction, where T is the radius divided by the standard deviation of
the center.
"""
MIN_SIGNIFICANCE = 7.0
"""Number of standard deviations by which the rotation in the third direction, which has the least
rotation, must exceed the apparent rotation that noise causes. Without this limit, the noise of many
frames would seem to determine the center along the axis of a hinge.
"""
FADED = 0.5 ** LAGS[1]
"""Largest correlation over `LAGS[1]` frames that is attributed to noise. The value applies to noise
whose correlation halves from frame to frame. A larger correlation is attributed to soft-tissue
artefact.
"""
FILLED = 0.1
"""Ratio of the variance of the radial residuals to the variance of the path, above which the path
does not count as an arc.
"""
_STILL_M = 1e-6
_PERSISTENT = 0.99
_CHI2 = (3.841, 5.991, 7.815)  # 95 % quantiles of χ² for one, two, three degrees of freedom


@dataclass(frozen=True, slots=True)
class SphereLimits:
    """Acceptance limits of a center in space."""

    min_direction: float = 0.0
    """RMS rotation of the markers in the direction with the least rotation, rad, below which the
    joint counts as a hinge even if the noise is small. With soft-tissue artefact use 3°. The value
    must exceed the rotation of the parent's frame that noise causes, because such a rotation cannot
    be distinguished from joint rotation.
    """
    min_arc: float = radians(8.0)
    reach: tuple[float, float] = (0.02, 1.0)
    """Least and largest distance of the markers from the center, m."""
    posture: bool = True
    """Whether persistent residuals count as soft-tissue artefact. If False, the caller adds the
    variance of the artefact."""


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """Statistics of the radial residuals of a fit."""

    together: Array
    """Covariance of the radial residuals of each pair of markers, m², shape (k, k)."""
    persistence: float
    """Correlation of the residuals from one frame to the next, 0 to 0.99; 0 if not significant."""
    posture: float
    """Fraction of the residual variance that repeats with posture."""


@dataclass(frozen=True, slots=True)
class ObservedCenter:
    """Part of a center along the directions that the movement makes observable."""

    basis: Array
    """Directions of the fit as columns, shape (d, r)."""
    shown: Array
    """Directions that are observable despite soft-tissue artefact, as columns in coordinates of the
    basis, shape (r, s).
    """
    paths: MarkerPaths
    """Marker paths in coordinates of the basis."""
    found: ConcentricSpheres
    """Fitted center and radii in coordinates of the basis."""
    spread: Array
    """Covariance of the center in coordinates of the basis, m², shape (r, r)."""
    tilt: Array
    """Increase of `spread` per squared lever arm along unobserved directions, shape (r, r)."""
    bound2: float
    """Trace of the Cramér-Rao bound, m²."""
    left: ResidualStatistics
    within95: float
    """Squared Mahalanobis distance with 95 % coverage of the center."""


def moving_directions(paths: MarkerPaths) -> Array:
    """Return the directions in which any marker moved, shape (d, r)."""
    spread, axes = np.linalg.eigh(np.einsum("j,jab->ab", paths.n / paths.n.sum(), paths.C))
    return np.asarray(axes[:, spread > max(_STILL_M**2, 1e-12 * float(spread[-1]))])


def observe(
    sums: SphereSums, paths: MarkerPaths, basis: Array, limits: SphereLimits
) -> ObservedCenter | None:
    """Fit the center, and drop the least observable direction until all others are observable.

    A direction is dropped if its rotation is not significantly larger than noise. Directions that
    are observable only without soft-tissue artefact remain in the fit, because the residuals would
    be larger without them. `ObservedCenter.shown` does not contain these directions. The result is
    None if fewer than two directions are observable, or if the paths are not arcs.
    """
    while basis.shape[1] >= 2:
        flat = paths.seen_along(basis)
        found = common_center(flat)
        if found is None:
            basis = basis @ np.linalg.eigh(np.einsum("j,jab->ab", flat.n, flat.C))[1][:, 1:]
            continue

        # Largest information that noise alone may cause in the least observed direction, rad².
        spread, axes = np.linalg.eigh(found.information)
        radius2 = float(np.median(found.radii2))
        noise = max(MIN_CONDITIONING**2 * found.noise2 / radius2, 0.0)
        if len(spread) == 3:
            total = float(flat.n.sum())
            floor = float(axes[:, 0] @ found.floor @ axes[:, 0])
            chance = MIN_SIGNIFICANCE * floor * float(np.sqrt(2.0 / total))
            noise = max(noise, chance, limits.min_direction**2 * total)

        if spread[0] > noise:
            # If the paths fill an area that is as wide as it is long, they are the projection of a
            # small movement on a sphere along its radius. The curvature cannot be measured, and a
            # fitted circle is meaningless.
            wide = np.linalg.eigvalsh(np.einsum("j,jab->ab", flat.n / flat.n.sum(), flat.C))[-1]
            if found.noise2 * float(np.median(found.relative)) > FILLED * wide:
                return None

            left = _residuals(sums, basis, flat, found, limits)
            skin2 = found.noise2 + soft_tissue_variance(left, flat, found)
            shown = spread > MIN_CONDITIONING**2 * skin2 / radius2

            # If soft-tissue artefact leaves only one observable direction, this direction does not
            # determine a center. All directions are then used, and the predicted error is large.
            shown = shown if shown.sum() >= 2 else np.ones_like(shown)
            return _observed_center(sums, basis, flat, found, left=left, shown=axes[:, shown])

        basis = basis @ axes[:, 1:]

    return None


def soft_tissue_variance(
    left: ResidualStatistics, paths: MarkerPaths, found: ConcentricSpheres
) -> float:
    r"""Return p² times the weighted number of marker positions, m².

    The caller multiplies the result by the inverse of the information matrix, which is a sum over
    all marker positions. The product is the covariance from soft-tissue artefact,

    .. math:: \mathrm{Cov}_{posture} = p^2 \left[ \overline{u u^T} - \bar u \bar u^T \right]^{-1}

    where p² is the part of the residual variance that repeats with posture, and u are the unit
    vectors from the center to the markers. The part of the artefact that is linear in u moves the
    center without residuals. This part is assumed to be as large as the part that causes residuals.
    The artefact repeats with every cycle of the movement, and all markers share the soft tissue of
    their segment. Therefore neither more frames nor more markers reduce this variance.
    """
    return left.posture * found.noise2 * float((paths.n / found.relative).sum())


def posture_share(lasting: float, frames: float) -> float:
    """Return the fraction of the residual variance that repeats with posture.

    The fraction is the correlation of the residuals over `LAGS[1]` frames. It is zero if this
    correlation is less than three standard errors above `FADED`.
    """
    # A correlation ρ per frame divides the effective number of frames by (1 + ρ²)/(1 - ρ²).
    chance = FADED + 3.0 * float(np.sqrt((5.0 / 3.0) / max(frames, 1.0)))
    return min(lasting, 1.0) if lasting > chance else 0.0


def within95(rank: int, freedom: float) -> float:
    r"""Return the squared Mahalanobis distance with 95 % coverage of a center.

    .. math:: r F_{0.95}(r, \nu) \approx \chi^2 \left( 1 + \frac{\chi^2 - r + 2}{2 \nu} \right)

    for r directions and noise that is estimated with ν degrees of freedom. χ² is the 95 % quantile
    for r degrees of freedom.
    """
    chi2 = _CHI2[rank - 1]
    return chi2 * (1.0 + (chi2 - rank + 2.0) / (2.0 * max(freedom, 2.0)))


def _observed_center(
    sums: SphereSums,
    basis: Array,
    paths: MarkerPaths,
    found: ConcentricSpheres,
    *,
    left: ResidualStatistics,
    shown: Array,
) -> ObservedCenter:
    r"""Return the center with its covariance from the sandwich formula.

    .. math:: \mathrm{Cov} = B^{-1} \Big[ \sum_{jl} \frac{n_{jl}\, \overline{e_j e_l}\;
              \overline{u_j u_l^T}}{s_j s_l} \Big] B^{-1} \cdot \frac{1+\rho\rho_u}{1-\rho\rho_u}

    where e are the radial residuals of markers j and l, u the unit vectors from the center to the
    markers, s the relative noise, and B the information. n_jl is the number of frames in which both
    markers are visible. ρ and ρ_u are the correlations of e and of u from one frame to the next.
    Correlated residuals e increase the covariance only if the directions u are correlated as well.
    The function adds `soft_tissue_variance` divided by the information.
    """
    k, rank = paths.mean.shape
    total = float(paths.n.sum())
    together, rho = left.together, left.persistence
    both = rho * _smoothness(sums, paths, found)
    weights = np.maximum(sums.weights, 1e-300)
    pairs = np.maximum(sums.M[:, -1, :, -1], 0.0)
    X = np.einsum("ap,jalb,bq->jlpq", basis, sums.M[:, 1:-1, :, 1:-1], basis)
    X /= np.maximum(pairs, 1e-300)[:, :, None, None]
    index = np.arange(k)
    X[index, index] -= (found.noise2 * found.relative)[:, None, None] * paths.S
    scale = np.sqrt(found.radii2) * found.relative
    joint = np.sqrt(np.outer(paths.n / weights, paths.n / weights)) * pairs
    meat = np.einsum("jl,jlpq->pq", joint * together / np.outer(scale, scale), X)
    bread = np.linalg.inv(found.information)
    dof = max(total * (1.0 - rho) / (1.0 + rho) - k - rank, 2.0)

    # A fit reduces residuals of persistent noise more than residuals of white noise.
    own = total * (1.0 - both) / (1.0 + both)
    widened = total / max(own - k - rank, 1.0)
    bound2 = found.noise2 * float(np.trace(bread))
    spread = _no_better(bread @ meat @ bread, np.asarray(found.noise2 * bread)) * widened
    spread = spread + soft_tissue_variance(left, paths, found) * bread
    path = np.einsum("j,jab->ab", paths.n / found.relative, paths.C)

    # Variance of the normal of a plane that is fitted to the paths.
    tilt = (found.noise2 + soft_tissue_variance(left, paths, found)) * np.linalg.inv(path)
    size = within95(shown.shape[1], dof)
    return ObservedCenter(basis, shown, paths, found, spread, tilt, bound2, left, size)


def _no_better(spread: Array, white: Array) -> Array:
    """Return `spread`, increased to at least a quarter of the white-noise covariance.

    With few frames, correlations between markers that occur by chance could make `spread` almost
    zero.
    """
    L = np.linalg.cholesky((white + white.T) / 2.0)
    inner = np.linalg.solve(L, np.linalg.solve(L, spread).T)
    values, axes = np.linalg.eigh((inner + inner.T) / 2.0)
    T = L @ axes
    return np.asarray((T * np.maximum(values, 0.25)) @ T.T)


def _smoothness(sums: SphereSums, paths: MarkerPaths, found: ConcentricSpheres) -> float:
    """Return the correlation of the markers' directions from one frame to the next, 0 to 1."""
    w = paths.n / (found.radii2 * found.relative)
    after = np.einsum("jaa->j", sums.L[0, :, 1:-1, 1:-1])
    after /= np.maximum(sums.L[0, :, -1, -1], 1e-300)
    own = np.einsum("jaja->j", sums.M[:, 1:-1, :, 1:-1]) / np.maximum(sums.weights, 1e-300)
    return float(np.clip((w @ after) / max(float(w @ own), 1e-300), 0.0, 1.0))


def _residuals(
    sums: SphereSums,
    basis: Array,
    paths: MarkerPaths,
    found: ConcentricSpheres,
    limits: SphereLimits,
) -> ResidualStatistics:
    a = (found.center - paths.mean) @ basis.T
    ones = np.ones((len(a), 1))
    f = np.concatenate((ones, -2.0 * a, -np.einsum("jaa->j", paths.C)[:, None]), axis=1)
    f /= 2.0 * np.sqrt(found.radii2)[:, None]
    products = np.einsum("ja,jalb,lb->jl", f, sums.M, f)
    together = products / np.maximum(sums.M[:, -1, :, -1], 1e-300)
    lagged = np.einsum("ja,gjab,jb->gj", f, sums.L, f)
    lagged /= np.maximum(sums.L[:, :, -1, -1], 1e-300)
    share = paths.n / found.relative
    power = float(share @ np.diagonal(together))
    rho, lasting = (lagged @ share / max(power, 1e-300)).tolist()

    # A correlation below the sampling error of white noise is set to zero.
    rho = min(rho, _PERSISTENT) if rho > 2.0 / np.sqrt(paths.n.sum()) else 0.0
    posture = posture_share(lasting, float(paths.n.mean())) if limits.posture else 0.0
    return ResidualStatistics(together, rho, posture)
