r"""Which directions of a center the movement showed, and how well it is known in them.

Law: a direction counts as seen if the movement turned the markers along it beyond what noise does,
and the center is known there to a sixth of the radius. The covariance is widened for residuals that
persist from frame to frame and for noise that markers share, all from the same sums. What goes with
posture is no noise: it repeats, and all frames together are one observation of it.
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
    from jointfit_daemon.center_of_rotation.spatial._concentric_spheres import Paths, Spheres
    from jointfit_daemon.center_of_rotation.spatial._sphere_sums import SphereSums


MIN_CONDITIONING = 6.0
"""T: radius over the center's standard deviation, below which a direction is not seen."""
MIN_SIGNIFICANCE = 7.0
"""Standard deviations by which the turning along a third direction must exceed what noise turns:
many frames of noise along a hinge's axis would pass for a well-conditioned center."""
FADED = 0.5 ** LAGS[1]
"""Correlation over `LAGS[1]` frames of noise that halves itself each frame: what lasts longer goes
with posture."""
FILLED = 0.1
"""Share of the movement's variance from which residuals are no noise about an arc."""
_STILL_M = 1e-6
_PERSISTENT = 0.99
_CHI2 = (3.841, 5.991, 7.815)  # 95 % of one, two, three squares


@dataclass(frozen=True, slots=True)
class Limits:
    """When a center is not to be used."""

    min_direction: float = 0.0
    """RMS turning of the markers along the third direction, rad, below which the joint is taken for
    a hinge whatever the noise: 3° on skin; more than the turns that noise gives the parent's frame,
    which look like the joint's own."""
    min_arc: float = radians(8.0)
    reach: tuple[float, float] = (0.02, 1.0)
    """Least and largest distance of the markers from the center, m."""
    posture: bool = True
    """Count residuals that last as going with posture. False: who asks adds skin himself."""


@dataclass(frozen=True, slots=True)
class Residuals:
    """What the radial residuals of a fit are like."""

    together: Array
    """Covariance from marker to marker, m², shape (k, k)."""
    persistence: float
    """Correlation from one frame to the next, 0 to 0.99; chance is 0."""
    posture: float
    """Share of their variance that goes with posture."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What the movement shows of a center."""

    basis: Array
    """Directions of the fit, the columns, shape (d, r)."""
    shown: Array
    """Those of them that more than skin shows, along the basis, the columns, shape (r, s)."""
    paths: Paths
    """Along them."""
    found: Spheres
    spread: Array
    """Covariance along the basis, m², shape (r, r)."""
    tilt: Array
    """How much of a squared lever along the unseen direction joins it, shape (r, r)."""
    bound2: float
    """Trace of the Cramér-Rao bound, m²."""
    left: Residuals
    within95: float
    """Squared Mahalanobis distance that holds the center 95 times in a hundred."""


def moved(paths: Paths) -> Array:
    """Return the directions in which anything moved at all, shape (d, r)."""
    spread, axes = np.linalg.eigh(np.einsum("j,jab->ab", paths.n / paths.n.sum(), paths.C))
    return np.asarray(axes[:, spread > max(_STILL_M**2, 1e-12 * float(spread[-1]))])


def observe(sums: SphereSums, paths: Paths, basis: Array, limits: Limits) -> Seen | None:
    """Fit, and give up the direction that is seen least until all that are left are seen.

    What noise hides is left out of the fit. What only skin shows stays in the fit, since residuals
    would grow without it, and is hidden from the answer.
    """
    while basis.shape[1] >= 2:
        flat = paths.seen_along(basis)
        found = common_center(flat)
        if found is None:
            basis = basis @ np.linalg.eigh(np.einsum("j,jab->ab", flat.n, flat.C))[1][:, 1:]
            continue
        spread, axes = np.linalg.eigh(found.information)
        if spread[0] > _hidden_by_noise(axes[:, 0], flat, found, limits):
            if _filled(flat, found):
                return None
            left = _residuals(sums, basis, flat, found, limits)
            skin2 = found.noise2 + skin_of(left, flat, found)
            shown = spread > MIN_CONDITIONING**2 * skin2 / float(np.median(found.radii2))
            # of one direction alone no center is known: then the error says so
            shown = shown if shown.sum() >= 2 else np.ones_like(shown)
            return _spread(sums, basis, flat, found, left=left, shown=axes[:, shown])
        basis = basis @ axes[:, 1:]
    return None


def _hidden_by_noise(direction: Array, paths: Paths, found: Spheres, limits: Limits) -> float:
    """Return the information, in squared radians, that noise may bring along a direction."""
    total = float(paths.n.sum())
    enough = MIN_CONDITIONING**2 * found.noise2 / float(np.median(found.radii2))
    if len(direction) < 3:
        return max(enough, 0.0)
    floor = float(direction @ found.floor @ direction)
    chance = MIN_SIGNIFICANCE * floor * float(np.sqrt(2.0 / total))
    return max(enough, chance, limits.min_direction**2 * total, 0.0)


def _filled(paths: Paths, found: Spheres) -> bool:
    """Tell whether paths fill an area as wide as it is long: a small movement seen face on.

    Its center lies before or behind it, too far for the bend to show; a circle in it is chance.
    """
    wide = np.linalg.eigvalsh(np.einsum("j,jab->ab", paths.n / paths.n.sum(), paths.C))[-1]
    noise2 = found.noise2 * float(np.median(found.relative))
    return bool(noise2 > FILLED * wide)


def skin_of(left: Residuals, paths: Paths, found: Spheres) -> float:
    r"""Return what goes with posture, for all frames together, m²: over the information, Cov.

    .. math:: \mathrm{Cov}_{posture} = p^2 \left[ \overline{u u^T} - \bar u \bar u^T \right]^{-1}

    p² the variance of the residuals that lasts. The part of skin motion that is linear in the
    directions u moves the center and leaves no residual; it is taken to be as large as the rest,
    which does. It repeats with every cycle: no number of frames and no number of markers, which
    share their parent's skin, makes it less.
    """
    return left.posture * found.noise2 * float((paths.n / found.relative).sum())


def of_posture(lasting: float, frames: float) -> float:
    """Return the share of residuals that goes with posture.

    It is their correlation over `LAGS[1]` frames, if that is more than noise that has faded leaves
    by chance three times in a thousand.
    """
    # of a correlation ρ per frame, frames are worth (1 + ρ²)/(1 - ρ²) times less
    chance = FADED + 3.0 * float(np.sqrt((5.0 / 3.0) / max(frames, 1.0)))
    return min(lasting, 1.0) if lasting > chance else 0.0


def within95(rank: int, freedom: float) -> float:
    r"""Return the squared Mahalanobis distance that holds a center 95 times in a hundred.

    .. math:: r F_{0.95}(r, \nu) \approx \chi^2 \left( 1 + \frac{\chi^2 - r + 2}{2 \nu} \right)

    for r directions and a noise estimated with ν degrees of freedom.
    """
    chi2 = _CHI2[rank - 1]
    return chi2 * (1.0 + (chi2 - rank + 2.0) / (2.0 * max(freedom, 2.0)))


def _spread(
    sums: SphereSums,
    basis: Array,
    paths: Paths,
    found: Spheres,
    *,
    left: Residuals,
    shown: Array,
) -> Seen:
    r"""Return the covariance by the sandwich of what the residuals really have in common.

    .. math:: \mathrm{Cov} = B^{-1} \Big[ \sum_{jl} \frac{n_{jl}\, \overline{e_j e_l}\;
              \overline{u_j u_l^T}}{s_j s_l} \Big] B^{-1} \cdot \frac{1+\rho\rho_u}{1-\rho\rho_u}

    e the radial residuals, u the directions, s the relative noise, ρ and ρ_u their
    lag-one correlations (noise that lasts hurts only where the movement lasts, too); plus
    `skin_of` over the information.
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
    # a fit takes more out of noise that lasts
    own = total * (1.0 - both) / (1.0 + both)
    widened = total / max(own - k - rank, 1.0)
    bound2 = found.noise2 * float(np.trace(bread))
    spread = _no_better(bread @ meat @ bread, np.asarray(found.noise2 * bread)) * widened
    spread = spread + skin_of(left, paths, found) * bread
    path = np.einsum("j,jab->ab", paths.n / found.relative, paths.C)
    # of a plane through the paths
    tilt = (found.noise2 + skin_of(left, paths, found)) * np.linalg.inv(path)
    size = within95(shown.shape[1], dof)
    return Seen(basis, shown, paths, found, spread, tilt, bound2, left, size)


def _no_better(spread: Array, white: Array) -> Array:
    """Return `spread` no smaller in any direction than a quarter of what white noise gives.

    Few frames may show correlations between markers that are chance and would cancel all noise.
    """
    L = np.linalg.cholesky((white + white.T) / 2.0)
    inner = np.linalg.solve(L, np.linalg.solve(L, spread).T)
    values, axes = np.linalg.eigh((inner + inner.T) / 2.0)
    T = L @ axes
    return np.asarray((T * np.maximum(values, 0.25)) @ T.T)


def _smoothness(sums: SphereSums, paths: Paths, found: Spheres) -> float:
    """Return the correlation of the markers' directions from one frame to the next, 0 to 1."""
    w = paths.n / (found.radii2 * found.relative)
    after = np.einsum("jaa->j", sums.L[0, :, 1:-1, 1:-1])
    after /= np.maximum(sums.L[0, :, -1, -1], 1e-300)
    own = np.einsum("jaja->j", sums.M[:, 1:-1, :, 1:-1]) / np.maximum(sums.weights, 1e-300)
    return float(np.clip((w @ after) / max(float(w @ own), 1e-300), 0.0, 1.0))


def _residuals(
    sums: SphereSums, basis: Array, paths: Paths, found: Spheres, limits: Limits
) -> Residuals:
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
    # below what chance does to white noise, it is chance
    rho = min(rho, _PERSISTENT) if rho > 2.0 / np.sqrt(paths.n.sum()) else 0.0
    posture = of_posture(lasting, float(paths.n.mean())) if limits.posture else 0.0
    return Residuals(together, rho, posture)
