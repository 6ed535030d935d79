"""Center of rotation from a marker path and the measured angle of the child segment.

Positions and angles both have errors. Invariant: the distance of the result from the circle fit is
a bounded number of standard errors, even with arbitrary angle errors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, radians, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation.planar._circle_estimate import (
    CircleLimits,
    arc_about,
    circle_estimate,
    objection,
    refused_circle,
)
from jointfit_daemon.center_of_rotation.planar._circle_fit import Circles, fit_circles
from jointfit_daemon.center_of_rotation.planar._moments import GATE, seen_places

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation._result import CenterEstimate


METHOD = "oriented"
MAX_FRAMES = 300
INCONSISTENT = 13.8
"""Squared Mahalanobis distance above which two estimates are inconsistent. Of consistent pairs, one
in a thousand has a larger distance.
"""
_LEAST_NOISE_M = 1e-4
_PASSES = 40
_FAR_M = 1.0


@dataclass(frozen=True, slots=True)
class AngleNoise:
    """Error model of the measured angle of the child. Values are in rad unless stated otherwise."""

    slow: float = radians(1.5)
    """Standard deviation of the slow part, which soft-tissue artefact and heading drift cause."""
    time: float = 1.0
    """Correlation time of the slow part, s."""
    white: float = radians(1.0)
    """Standard deviation of the white noise."""
    gain: float = 0.02
    """Standard deviation of the scale error, rad/rad."""

    def covariance(self, times: Array, angles: Array) -> Array:
        """Return the covariance Σ of the angle errors at these times, rad², shape (n, n)."""
        slow = self.slow**2 * np.exp(-np.abs(times[:, None] - times) / self.time)
        turned = angles - angles.mean()
        return np.asarray(
            slow + self.white**2 * np.eye(len(times)) + self.gain**2 * np.outer(turned, turned)
        )


def oriented_estimate(
    points: ArrayLike,
    angles: ArrayLike,
    interval: float,
    *,
    noise: AngleNoise | None = None,
    limits: CircleLimits | None = None,
) -> CenterEstimate:
    r"""Estimate the center from the path of one marker and the measured angle of its segment.

    .. math::
        x_t &= c + \rho\, u(\theta_t + \beta + \delta_t) + \varepsilon_t \\
        J &= \sum_t e_t^2/\sigma^2 + a^T M a - \sigma^2 \sum_t M_{tt} / q_t^2,
            \qquad M = \left( (\sigma/\rho)^2 I + \Sigma_\theta \right)^{-1} \\
        q_t &= |x_t - c|, \quad e_t = q_t - \rho, \quad a_t = \arg(x_t - c) - \theta_t - \beta

    The first line is the model: c is the center, ρ the radius, u the unit vector at an angle, θ the
    measured angle of the child with error δ, and β the angle of the marker on the child. ε is
    marker noise of variance σ², and Σ_θ the covariance of δ. J is minimized over c, ρ and β. In a
    plain least-squares fit of the model, δ would reduce the radius. The last term of J subtracts
    the contribution of marker noise to aᵀMa. This contribution decreases with the distance of the
    center, and would bias c outward.

    A guard limits the effect of the angles (limited translation, Efron and Morris 1971). Let Δ be
    the difference between the center with angles and the center of the circle fit. Let E be the
    covariance of Δ under the error model `noise`, s² = ΔᵀE⁻¹Δ, and T the conditioning of the circle
    fit. The result is

    .. math:: c = c_{circle} + \Delta \min(1, \lambda/s), \qquad
              \lambda = 0.7 \left( 1 + (6/T)^2/2 \right)

    so that an angle error of any size adds no more than λ²E to the mean square error. λ is larger
    for small T, where the error of the circle fit has a heavier tail than its covariance implies.

    Parameters
    ----------
    points : array_like, shape (n, 2)
        Marker in the parent's coordinates, m; NaN where missing. A longer path is averaged in
        groups of successive frames, to 300 positions.
    angles : array_like, shape (n,)
        Angle of the child about the joint's axis relative to the parent, rad; NaN if unknown. The
        zero of the angle is arbitrary.
    interval : float
        Time between frames, s.
    noise : AngleNoise, optional
        Error model of the angles.
    limits : CircleLimits, optional
        Acceptance limits. T is the radius divided by the largest standard error of the combined
        center.

    Returns
    -------
    CenterEstimate
        Estimate. It has the flag ``orientation_inconsistent`` if path and angles are inconsistent.
    """
    x, theta, times = _thin(points, angles, interval)
    allowed = limits or CircleLimits()
    if len(x) < 4:
        reason = (
            f"{len(x)} frames with marker and angle, at least 4 are required: record a longer trial"
        )
        return refused_circle(METHOD, (0.0, 0.0), len(x), reason)

    if float(np.ptp(theta)) < allowed.arc:
        turned = np.degrees(np.ptp(theta))
        reason = f"the joint turned {turned:.0f}°: move it through at least 30°"
        return refused_circle(METHOD, (0.0, 0.0), len(x), reason)

    alone = circle_estimate(x, limits=CircleLimits(0.0, (0.0, inf), 0.0, inf))
    if alone.refused and "motion" in alone.refused:
        return replace(alone, method=METHOD)
    sigma = max(_path_noise(x), _LEAST_NOISE_M)

    # The covariance of the scale error uses angles that a quadratic function predicts from the
    # positions. Measured angles contain noise that is correlated with the residuals and would bias
    # the center.
    d = (x - x.mean(axis=0)) / max(float(x.std()), 1e-9)
    one, u, v = np.ones(len(x)), d[:, 0], d[:, 1]
    terms = np.column_stack((one, u, v, u * u, u * v, v * v))
    smooth = np.asarray(terms @ np.linalg.lstsq(terms, theta, rcond=None)[0])
    Sigma = (noise or AngleNoise()).covariance(times, smooth)
    try:
        aided = _solve(x, theta, sigma, Sigma)
    except np.linalg.LinAlgError:  # there is no information in at least one direction
        aided = None

    if aided is None and alone.refused is None:
        path_alone = circle_estimate(x, limits=allowed)
        return replace(path_alone, method=METHOD, flags=("orientation_inconsistent",))
    if aided is None:
        reason = (
            "path and angles do not fit one center: check the axis or increase the range of motion"
        )
        return refused_circle(METHOD, (0.0, 0.0), len(x), reason)

    center, covariance, residual = aided
    held = limit_center(center, covariance, fit_circles(x))
    return replace(
        _accept_estimate(x, held, alone, allowed),
        noise=sigma,
        residual=residual,
        bound=min(alone.bound, sqrt(float(np.trace(covariance)))),
    )


def limit_center(center: Array, C: Array, circle: Circles) -> tuple[Array, Array, float]:
    """Limit the distance between a center estimated with angles and the circle fit of the path.

    Parameters
    ----------
    center : ndarray, shape (2,)
        Center estimated with the angles, m.
    C : ndarray, shape (2, 2)
        Covariance of `center` under the error model of the angles, m².
    circle : Circles
        Circle fit of the path alone. If the circle is not valid, the center is returned unchanged.

    Returns
    -------
    center, covariance, s2 : ndarray, ndarray, float
        Limited center, m, its covariance, m², and s², the squared Mahalanobis distance between the
        two centers. The covariance includes a term for a remaining inconsistency of path and
        angles.
    """
    if not bool(circle.valid):
        return center, C, 0.0
    spread, axes = np.linalg.eigh(circle.covariance)
    # E, the covariance of the difference between the two centers, may be nearly singular or
    # indefinite. Its variances are therefore set to at least a quarter of the variances of the
    # circle's center.
    apart = np.einsum("ai,ab,bi->i", axes, circle.covariance - C, axes)
    apart = np.maximum(apart, 0.25 * np.maximum(spread, 1e-18))
    delta = center - circle.center
    s2 = float(((axes.T @ delta) ** 2 / apart).sum())
    reach = 0.7 * (1.0 + 0.5 * (GATE / max(float(circle.conditioning), 1e-3)) ** 2)
    kept = min(1.0, reach / sqrt(s2)) if s2 > 0.0 else 1.0
    given = 1.0 - kept
    E = (axes * apart) @ axes.T
    covariance = C + given**2 * E + given * kept**2 * np.outer(delta, delta)

    return circle.center + kept * delta, covariance, s2


def _thin(points: ArrayLike, angles: ArrayLike, interval: float) -> tuple[Array, Array, Array]:
    """Return positions, angles and times of the frames with marker and angle.

    More than `MAX_FRAMES` frames are averaged in groups of successive frames.
    """
    x = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    theta = np.asarray(angles, dtype=np.float64).ravel()
    seen = seen_places(x) & np.isfinite(theta)
    times = np.asarray(interval * np.flatnonzero(seen), dtype=np.float64)
    x, theta = x[seen], np.asarray(np.unwrap(theta[seen]), dtype=np.float64)
    if len(x) <= MAX_FRAMES:
        return x, theta, times
    parts = np.linspace(0, len(x), MAX_FRAMES + 1).astype(int)[:-1]
    count = np.diff(parts, append=len(x))
    averaged: Array = np.add.reduceat(np.column_stack((x, theta, times)), parts, axis=0)
    averaged = averaged / count[:, None]

    return averaged[:, :2], averaged[:, 2], averaged[:, 3]


def _path_noise(x: Array) -> float:
    circle = fit_circles(x)
    if bool(circle.valid):
        return float(circle.noise)
    # The arc is nearly straight. The noise is the RMS distance of the points from a parabola.
    d = x - x.mean(axis=0)
    along, across = (d @ np.linalg.svd(d, full_matrices=False)[2].T).T
    terms = np.column_stack((np.ones(len(x)), along, along**2))
    return float(np.std(across - terms @ np.linalg.lstsq(terms, across, rcond=None)[0]))


def _solve(x: Array, theta: Array, sigma: float, Sigma: Array) -> tuple[Array, Array, float] | None:
    """Minimize J by Gauss-Newton iteration from a plain least-squares solution.

    Returns
    -------
    center, covariance, residual or None
        Center, m, its covariance, m², and the RMS radial residual, m; None where J has no minimum.
    """
    # start at the linear least-squares solution of x = c + R(θ) p, whose radius is too small
    c, s, one, zero = np.cos(theta), np.sin(theta), np.ones_like(theta), np.zeros_like(theta)
    A = np.concatenate((np.column_stack((one, zero, c, -s)), np.column_stack((zero, one, s, c))))
    found = np.linalg.lstsq(A, x.T.ravel(), rcond=None)[0]
    rho, beta = np.hypot(found[2], found[3]), np.arctan2(found[3], found[2])
    z, start = np.array([found[0], found[1], rho, beta]), x.mean(axis=0)

    M: Array = np.eye(len(x))
    rho0 = -1.0
    H = np.eye(4)

    for _ in range(_PASSES):
        if not (np.isfinite(z).all() and 1e-3 < z[2] < 2.0 * _FAR_M):
            return None
        if abs(z[2] / rho0 - 1.0) > 0.02:
            rho0 = float(z[2])
            M = np.asarray(np.linalg.inv((sigma / rho0) ** 2 * np.eye(len(x)) + Sigma))

        H, g = _normal(x, theta, z, M, sigma=sigma, rho0=rho0)
        step = -np.linalg.solve(H, g)
        step *= min(1.0, 0.3 * z[2] / max(float(np.hypot(step[0], step[1])), 1e-12))
        z = z + step
        if float(np.abs(step[:3]).max()) < 1e-8:
            break

    C = np.asarray(np.linalg.inv(H)[:2, :2])
    if not (np.linalg.eigvalsh(C)[0] > 0.0 and np.linalg.norm(z[:2] - start) <= _FAR_M):
        return None
    e = np.linalg.norm(x - z[:2], axis=1) - z[2]
    return z[:2], C, float(np.sqrt((e**2).mean()))


def _normal(
    x: Array, theta: Array, z: Array, M: Array, *, sigma: float, rho0: float
) -> tuple[Array, Array]:
    """Return the Gauss-Newton matrix and half the gradient of J with respect to (c, ρ, β)."""
    d = x - z[:2]
    q = np.maximum(np.linalg.norm(d, axis=1), 1e-9)
    e = q - z[2]
    a = np.angle(np.exp(1j * (np.arctan2(d[:, 1], d[:, 0]) - theta - z[3])))
    one, zero = np.ones_like(q), np.zeros_like(q)
    Je = np.column_stack((-d / q[:, None], -one, zero))
    Ja = np.column_stack((d[:, 1] / q**2, -d[:, 0] / q**2, zero, -one))
    MJ = M @ Ja
    H = Je.T @ Je / sigma**2 + Ja.T @ MJ
    g = Je.T @ e / sigma**2 + MJ.T @ a

    # points close to the center are excluded, because the last term of J diverges there
    counted = np.where(q > rho0 / 2, np.diag(M) / q**4, 0.0)
    g[:2] -= sigma**2 * counted @ d
    return H, g


def _accept_estimate(
    x: Array, held: tuple[Array, Array, float], alone: CenterEstimate, limits: CircleLimits
) -> CenterEstimate:
    """Return the estimate `alone` with the limited center `held`, refused if outside the limits."""
    center, C, s2 = held
    radius = float(np.linalg.norm(x - center, axis=1).mean())
    largest = float(np.linalg.eigvalsh(C)[-1])
    T = radius / sqrt(largest)
    arc = arc_about(x, center)
    sd = float(np.sqrt(np.trace(C)))

    return replace(
        alone,
        method=METHOD,
        center=center,
        covariance=C,
        radii=np.array([radius]),
        arc=arc,
        conditioning=T,
        unseen=np.zeros((0, 2)),
        flags=("orientation_inconsistent",) if s2 > INCONSISTENT else (),
        within95=None,
        refused=objection(radius, arc, T, sd, limits),
    )
