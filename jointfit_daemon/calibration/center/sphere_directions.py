r"""Which directions of a center the movement showed, and how well it is known in them.

Law: a direction counts as seen if the movement turned the markers along it beyond what noise does,
and the center is known there to a sixth of the radius. The covariance's 95 % ellipse covers 95 %:
it is widened for the few degrees of freedom of its noise, for residuals that persist from frame to
frame and for noise that markers share, all from the same sums.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jointfit_daemon.calibration.center.sphere_algebra import common_center

if TYPE_CHECKING:
    from jointfit_daemon.calibration.center.sphere_algebra import Paths, Spheres
    from jointfit_daemon.calibration.center.sphere_sums import SphereSums

Array = NDArray[np.float64]

MIN_CONDITIONING = 6.0
"""T: radius over the center's standard deviation, below which a direction is not seen."""
MIN_SIGNIFICANCE = 7.0
"""Standard deviations by which the turning along a third direction must exceed what noise turns:
many frames of noise along a hinge's axis would pass for a well-conditioned center."""
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


@dataclass(frozen=True, slots=True)
class Seen:
    """What the movement shows of a center."""

    basis: Array
    """Directions that were seen, the columns, shape (d, r)."""
    paths: Paths
    """Along them."""
    found: Spheres
    spread: Array
    """Covariance along the basis, m², shape (r, r)."""
    tilt: Array
    """How much of a squared lever along the unseen direction joins it, shape (r, r)."""
    residual2: Array
    """Mean square of the radial residuals of each marker, m², shape (k,)."""
    bound2: float
    """Trace of the Cramér-Rao bound, m²."""
    persistence: float
    """Correlation of the residuals from one frame to the next, 0 to 0.99."""


def moved(paths: Paths) -> Array:
    """Return the directions in which anything moved at all, shape (d, r)."""
    spread, axes = np.linalg.eigh(np.einsum("j,jab->ab", paths.n / paths.n.sum(), paths.C))
    return np.asarray(axes[:, spread > max(_STILL_M**2, 1e-12 * float(spread[-1]))])


def observe(sums: SphereSums, paths: Paths, basis: Array, limits: Limits) -> Seen | None:
    """Fit, and give up the direction that is seen least until all that are left are seen."""
    while basis.shape[1] >= 2:
        flat = paths.seen_along(basis)
        found = common_center(flat)
        if found is None:
            basis = basis @ np.linalg.eigh(np.einsum("j,jab->ab", flat.n, flat.C))[1][:, 1:]
            continue
        spread, axes = np.linalg.eigh(found.information)
        direction, total = axes[:, 0], float(flat.n.sum())
        floor = float(direction @ found.floor @ direction)
        clear = spread[0] > max(
            (basis.shape[1] == 3) * MIN_SIGNIFICANCE * floor * np.sqrt(2.0 / total),
            MIN_CONDITIONING**2 * found.noise2 / float(np.median(found.radii2)),
            (basis.shape[1] == 3) * limits.min_direction**2 * total,
            0.0,
        )
        if clear:
            return None if _filled(flat, found) else _spread(sums, basis, flat, found)
        basis = basis @ axes[:, 1:]
    return None


def _filled(paths: Paths, found: Spheres) -> bool:
    """Tell whether paths fill an area as wide as it is long: a small movement seen face on.

    Its center lies before or behind it, too far for the bend to show; a circle in it is chance.
    """
    wide = np.linalg.eigvalsh(np.einsum("j,jab->ab", paths.n / paths.n.sum(), paths.C))[-1]
    noise2 = found.noise2 * float(np.median(found.relative))
    return bool(noise2 > FILLED * wide)


def _spread(sums: SphereSums, basis: Array, paths: Paths, found: Spheres) -> Seen:
    r"""Return the covariance by the sandwich of what the residuals really have in common.

    .. math:: \mathrm{Cov} = B^{-1} \Big[ \sum_{jl} \frac{n_{jl}\, \overline{e_j e_l}\;
              \overline{u_j u_l^T}}{s_j s_l} \Big] B^{-1} \cdot \frac{1+\rho\rho_u}{1-\rho\rho_u}

    e the radial residuals, u the directions, s the relative noise, ρ and ρ_u their
    lag-one correlations (noise that lasts hurts only where the movement lasts, too); times
    what turns the normal quantile into Hotelling's for the degrees of freedom at hand.
    """
    k, rank = paths.mean.shape
    total = float(paths.n.sum())
    together, rho = _residuals(sums, basis, paths, found)
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
    widened *= 1.0 + (_CHI2[rank - 1] - rank + 2.0) / (2.0 * dof)
    bound2 = found.noise2 * float(np.trace(bread))
    spread = _no_better(bread @ meat @ bread, np.asarray(found.noise2 * bread)) * widened
    path = np.einsum("j,jab->ab", paths.n / found.relative, paths.C)
    tilt = found.noise2 * np.linalg.inv(path)  # of a plane through the paths
    return Seen(
        basis, paths, found, spread, tilt, np.maximum(np.diagonal(together), 0.0), bound2, rho
    )


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
    after = np.einsum("jaa->j", sums.L[:, 1:-1, 1:-1]) / np.maximum(sums.L[:, -1, -1], 1e-300)
    own = np.einsum("jaja->j", sums.M[:, 1:-1, :, 1:-1]) / np.maximum(sums.weights, 1e-300)
    return float(np.clip((w @ after) / max(float(w @ own), 1e-300), 0.0, 1.0))


def _residuals(sums: SphereSums, basis: Array, paths: Paths, found: Spheres) -> tuple[Array, float]:
    """Return the covariance of the radial residuals of markers, (k, k), and their persistence."""
    a = (found.center - paths.mean) @ basis.T
    ones = np.ones((len(a), 1))
    f = np.concatenate((ones, -2.0 * a, -np.einsum("jaa->j", paths.C)[:, None]), axis=1)
    f /= 2.0 * np.sqrt(found.radii2)[:, None]
    products = np.einsum("ja,jalb,lb->jl", f, sums.M, f)
    together = products / np.maximum(sums.M[:, -1, :, -1], 1e-300)
    lagged = np.einsum("ja,jab,jb->j", f, sums.L, f) / np.maximum(sums.L[:, -1, -1], 1e-300)
    share = paths.n / found.relative
    power = float(share @ np.diagonal(together))
    rho = float(share @ lagged) / max(power, 1e-300)
    # below what chance does to white noise, it is chance
    chance = 2.0 / float(np.sqrt(paths.n.sum()))
    return together, min(rho, _PERSISTENT) if rho > chance else 0.0
