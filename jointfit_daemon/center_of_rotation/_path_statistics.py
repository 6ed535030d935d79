"""Statistics of marker paths that planar and spatial estimators share."""

from __future__ import annotations

from math import pi, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array


def lag_one_correlation(e: Array, seen: NDArray[np.bool_]) -> float:
    """Return the correlation of residuals e, shape (n, k), between successive frames.

    The result is between 0 and 0.99; it is 0 if the correlation is not significant. `seen` is the
    mask of the visible markers, shape (n, k).
    """
    both = seen[1:] & seen[:-1]
    count = int(np.count_nonzero(seen))
    power = float((e[seen] ** 2).sum()) / max(count, 1)
    if power < 1e-18 or not both.any():
        return 0.0
    rho = float((e[1:] * e[:-1])[both].mean()) / power
    return min(rho, 0.99) if rho > 2.0 / sqrt(count) else 0.0


def variance_inflation(rho: float) -> float:
    r"""Return :math:`(1+\rho)/(1-\rho)`, the increase of the variance for correlated residuals.

    If the lag-one correlation is ρ, the effective number of frames is n divided by this factor.
    """
    return (1.0 + rho) / (1.0 - rho)


def radial_residuals(v: Array, m: Array, w: Array) -> tuple[Array, Array]:
    """Return radial residuals of k markers, and their derivatives with respect to the center.

    Parameters
    ----------
    v : ndarray, shape (n, k, d)
        Points, m; finite.
    m : ndarray, shape (d,)
        Center, m.
    w : ndarray, shape (n, k)
        Weight of each point in the mean distance; zero where a point is missing.

    Returns
    -------
    e, J : ndarray, shapes (n, k) and (n, k, d)
        Distances minus their weighted means, m, and their dimensionless derivatives.
    """
    d = v - m
    u = np.linalg.norm(d, axis=-1)
    total = np.maximum(w.sum(axis=0), 1e-12)
    e = u - np.where(w > 0.0, w * u, 0.0).sum(axis=0) / total
    direction = d / np.maximum(u, 1e-9)[..., None]
    mean = np.where(w[..., None] > 0.0, w[..., None] * direction, 0.0).sum(axis=0) / total[:, None]
    return e, mean - direction


def arc_of_spread(spread: float) -> float:
    r"""Return the angle, rad, of an arc whose evenly spaced points have variance `spread` R².

    R is the radius of the arc.

    .. math:: 1 - \left( \frac{\sin(\varphi/2)}{\varphi/2} \right)^2 = \text{spread}
    """
    if spread <= 0.0:
        return 0.0
    if spread >= 1.0:
        return 2.0 * pi
    low, high = 0.0, pi
    for _ in range(30):
        half = (low + high) / 2
        low, high = (half, high) if 1.0 - (sin(half) / half) ** 2 < spread else (low, half)

    return low + high


def arc_of(resultant: float) -> float:
    """Return the arc, rad, of evenly spread unit vectors whose mean has the length `resultant`."""
    return arc_of_spread(1.0 - min(max(resultant, 0.0), 1.0) ** 2)
