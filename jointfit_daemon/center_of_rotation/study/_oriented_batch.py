"""The orientation-aided fit for many runs at once, for the Monte Carlo study.

Cost function, start and guard are the same as in `planar.oriented_estimate`. The computation is
optimized for thousands of short movements with the same number of frames and evenly increasing
angles.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jointfit_daemon.center_of_rotation.planar import GATE, AngleNoise, Circles, fit_circles

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

Complex = NDArray[np.complex128]

_TOLD = AngleNoise()
_STEPS = 12
_LEAST_NOISE_M = 1e-6
_STUCK = 1e3
"""Damping above which the iteration of a run ends."""


class _Weights(NamedTuple):
    """Inverse covariance M = U diag(d) Uᵀ - h hᵀ of the angles of every run."""

    U: Array
    """Orthogonal matrix U, shape (n, n)."""
    d: Array
    """Diagonal d of every run, shape (runs, n)."""
    h: Array
    """Vector h of every run, shape (runs, n)."""

    def times(self, a: Array) -> Array:
        """Return M a of every run, shape (runs, n), or (runs, k, n) for k vectors in each run."""
        d, h = (self.d, self.h) if a.ndim == 2 else (self.d[:, None], self.h[:, None])
        plain = ((a @ self.U) * d) @ self.U.T
        return np.asarray(plain - (h * a).sum(axis=-1, keepdims=True) * h)

    def diagonal(self) -> Array:
        return np.asarray(self.d @ (self.U**2).T - self.h**2)


def oriented_centers(points: Array, angles: Array, interval: float = 0.02) -> Array:
    """Return centers from points and the child's angles, m, shape (..., 2).

    Parameters
    ----------
    points : ndarray, shape (..., n, 2)
        Marker positions, m; no NaN.
    angles : ndarray, shape (..., n)
        Measured angle of the child relative to the parent, rad.
    interval : float
        Time between frames, s.
    """
    shape, n = points.shape[:-2], points.shape[-2]
    z: Complex = (points[..., 0] + 1j * points[..., 1]).reshape(-1, n)
    theta = np.broadcast_to(angles, points.shape[:-1]).reshape(-1, n)
    circles = fit_circles(points.reshape(-1, n, 2))

    # start at the least-squares solution of z = c + w exp(iθ), as (x, y, |w|, arg w), (runs, 4)
    turn = np.exp(1j * theta)
    away = turn - turn.mean(axis=-1, keepdims=True)
    w = (z * away.conj()).sum(axis=-1) / (np.abs(away) ** 2).sum(axis=-1)
    c = z.mean(axis=-1) - w * turn.mean(axis=-1)
    start = np.stack((c.real, c.imag, np.abs(w), np.angle(w)), axis=-1)

    noise = np.where(
        circles.valid, circles.noise, np.abs(z - start[:, :1] - 1j * start[:, 1:2]).std(-1)
    )
    noise = np.maximum(noise, _LEAST_NOISE_M)
    found, H = start, np.zeros((len(z), 4, 4))

    # The covariance of the scale error uses a linear fit to the measured angles, because the true
    # angles increase evenly.
    values, U = _is_wandering(n, interval)
    even = np.arange(n) - 0.5 * (n - 1)
    g = _TOLD.gain * np.outer(theta @ even, even) / (even @ even)

    for _ in range(2):  # the angular noise depends on the radius
        radius = np.maximum(found[:, 2], 0.01)
        d = 1.0 / (values + (noise / radius)[:, None] ** 2)
        h = ((g @ U) * d) @ U.T
        weights = _Weights(U, d, h / np.sqrt(1.0 + (g * h).sum(axis=-1, keepdims=True)))
        found, H = _descend(_Runs(z, theta, noise, weights, weights.diagonal(), radius), found)

    return np.asarray(_limit_centers(found[:, :2], H, circles).reshape(*shape, 2))


@cache
def _is_wandering(n: int, interval: float) -> tuple[Array, Array]:
    """Return eigenvalues and eigenvectors of the angle covariance without the scale error."""
    apart = interval * np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    slow = _TOLD.slow**2 * np.exp(-apart / _TOLD.time)
    values, U = np.linalg.eigh(slow + _TOLD.white**2 * np.eye(n))
    return values, U


class _Runs(NamedTuple):
    """Data of the runs that are constant during the iteration."""

    z: Complex
    theta: Array
    noise: Array
    weights: _Weights
    diagonal: Array
    """Diagonal of M, shape (runs, n)."""
    rho0: Array
    """Radius with which M is computed, shape (runs,)."""

    def only(self, i: NDArray[np.intp]) -> _Runs:
        """Return the data of the selected runs."""
        U, d, h = self.weights
        kept = _Weights(U, d[i], h[i])
        return _Runs(self.z[i], self.theta[i], self.noise[i], kept, self.diagonal[i], self.rho0[i])


def _descend(runs: _Runs, start: Array) -> tuple[Array, Array]:
    """Run Levenberg-Marquardt on every run from (x, y, ρ, β); return parameters and Hessian."""
    at, mu = start.copy(), np.full(len(start), 1e-3)
    cost, g, H = _cost(runs, at)
    moving = np.arange(len(start))

    for _ in range(_STEPS):
        damped = H[moving] * (1.0 + mu[moving, None, None] * np.eye(4))
        tried = at[moving] - np.linalg.solve(damped, g[moving, :, None])[..., 0]
        after, g_after, H_after = _cost(runs.only(moving), tried)
        better = after < cost[moving]
        fell = cost[moving] - after > 1e-9 * np.abs(cost[moving])
        mu[moving] = np.where(better, np.maximum(0.2 * mu[moving], 1e-12), 5.0 * mu[moving])
        taken = moving[better]
        at[taken], cost[taken], g[taken], H[taken] = (
            x[better] for x in (tried, after, g_after, H_after)
        )
        moving = moving[fell | ((mu[moving] < _STUCK) & ~better)]
        if moving.size == 0:
            break

    return at, H


def _cost(runs: _Runs, at: Array) -> tuple[Array, Array, Array]:
    """Return the cost, half its gradient (runs, 4) and the Gauss-Newton matrix (runs, 4, 4)."""
    z, theta, noise, weights, diagonal, rho0 = runs
    d = z - (at[:, 0] + 1j * at[:, 1])[:, None]
    q = np.maximum(np.abs(d), 1e-9)
    e = (q - at[:, 2:3]) / noise[:, None]
    a = np.angle(d * np.exp(-1j * (theta + at[:, 3:])))
    Ma = weights.times(a)
    least, variance = 0.5 * rho0[:, None], (noise**2)[:, None]
    excess = (variance * diagonal / np.maximum(q, least) ** 2).sum(axis=-1)
    cost = (e**2).sum(axis=-1) + (a * Ma).sum(axis=-1) - excess
    one, zero = np.ones_like(q), np.zeros_like(q)
    Je = np.stack((-d.real / q, -d.imag / q, -one, zero), axis=1) / noise[:, None, None]
    Ja = np.stack((d.imag / q**2, -d.real / q**2, zero, -one), axis=1)
    H = Je @ Je.swapaxes(1, 2) + Ja @ weights.times(Ja).swapaxes(1, 2)
    g = (Je @ e[..., None] + Ja @ Ma[..., None])[..., 0]
    pull = np.where(q > least, variance * diagonal / q**4, 0.0)
    g[:, 0] -= (pull * d.real).sum(axis=-1)
    g[:, 1] -= (pull * d.imag).sum(axis=-1)

    return cost, g, H


def _limit_centers(center: Array, H: Array, circles: Circles) -> Array:
    """Limit the distance of the centers from the circle fits, like `limit_center` for one run."""
    C = np.linalg.inv(H + 1e-9 * H * np.eye(4))[:, :2, :2]
    held = circles.valid & (circles.noise > _LEAST_NOISE_M)
    of_circle = np.where(held[:, None, None], circles.covariance, np.eye(2))
    spread, axes = np.linalg.eigh(of_circle)
    apart = np.einsum("rai,rab,rbi->ri", axes, of_circle - C, axes)
    apart = np.maximum(apart, 0.25 * spread)
    delta = np.where(held[:, None], center - circles.center, 0.0)
    s = np.sqrt((np.einsum("rai,ra->ri", axes, delta) ** 2 / apart).sum(axis=-1))
    reach = 0.7 * (1.0 + 0.5 * (GATE / np.maximum(circles.conditioning, 1e-3)) ** 2)
    kept = np.minimum(1.0, reach / np.maximum(s, 1e-12))

    return np.asarray(np.where(held[:, None], center - (1.0 - kept)[:, None] * delta, center))
