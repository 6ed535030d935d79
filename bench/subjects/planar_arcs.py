"""Estimates of planar centers of rotation from many simulated arcs, and their evaluation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from bench.baselines.circle_theory import circle_rms_bound
from jointfit_daemon.center_of_rotation.planar import GATE, CircleMethod, ellipse_scale, fit_circles

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.arrays import Array


_AT_ONCE = 2000


@dataclass(frozen=True, slots=True)
class Runs:
    """Estimated centers of many runs. The true center is the origin."""

    centers: Array
    """Estimated centers, m, shape (runs, 2); NaN where no circle was found."""
    covariances: Array
    conditioning: Array
    bound: float
    """Cramér-Rao bound of the RMS error, m."""

    @property
    def published(self) -> NDArray[np.bool_]:
        return np.asarray(self.conditioning >= GATE)

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.nanmean((self.centers**2).sum(axis=1))))

    @property
    def claimed(self) -> float:
        return float(np.sqrt(np.nanmean(np.trace(self.covariances, axis1=1, axis2=2))))


def arc_points(angles: ArrayLike, radius: float) -> Array:
    """Return points of a circle about the origin, shape (..., 2)."""
    t = np.asarray(angles, dtype=np.float64)
    return radius * np.stack((np.cos(t), np.sin(t)), axis=-1)


@cache
def runs_on(
    n: int,
    arc: float,
    noise: float,
    *,
    radius: float = 0.3,
    runs: int = 20_000,
    method: CircleMethod = "hyper",
    tempered: bool = True,
    correlated: bool = False,
) -> Runs:
    """Return the fits of `runs` noisy arcs of `n` equidistant points over `arc` degrees.

    Both ends of an arc are points. `noise` is the standard deviation of a coordinate, m. With
    `tempered`, the centers are shrunk estimates: moved towards the points by the predicted bias.
    """
    rng = np.random.default_rng(round(1000 * arc) + n)
    t = np.linspace(-0.5, 0.5, n) * np.deg2rad(arc)
    truth = arc_points(t, radius)
    parts = []
    for _ in range(runs // _AT_ONCE):
        p = truth + rng.normal(0.0, noise, (_AT_ONCE, n, 2))
        parts.append(fit_circles(p, method=method, tempered=tempered, correlated=correlated))
    return Runs(
        np.concatenate([part.center for part in parts]),
        np.concatenate([part.covariance for part in parts]),
        np.concatenate([part.conditioning for part in parts]),
        circle_rms_bound(t, noise),
    )


def upper_rms(found: Runs) -> float:
    """Return the upper 95 % confidence limit of the RMS error, m, from the squared errors."""
    square = (found.centers**2).sum(axis=1)
    square = square[np.isfinite(square)]
    return float(np.sqrt(square.mean() + 1.645 * square.std() / np.sqrt(len(square))))


def share_covered(found: Runs, n: int) -> float:
    """Return the share of accepted centers whose 95 % ellipse contains the origin."""
    passed = found.published
    e, covariances = found.centers[passed], found.covariances[passed]
    d2 = np.einsum("ri,rij,rj->r", e, np.linalg.inv(covariances), e)
    scales = [ellipse_scale(float(n), float(t)) for t in found.conditioning[passed]]
    return float(np.mean(d2 <= scales))
