r"""Common center of the spheres (or circles) of several markers, from sums over frames.

Let x be the position of marker j relative to its mean, a the center, and R_j the radius. The
algebraic residual F = |x|² - 2 a·x - mean|x|² is 2 R_j times the radial residual. Therefore the
condition

.. math:: \min_a \sum_j \frac{n_j}{R_j^2 s_j} \left( \mathrm{var} F_j - \eta\, E_j(a) \right)
          = 0 \text{ at the smallest } \eta

gives all markers the weights of a geometric fit. n_j is the number of frames of marker j and s_j
its relative noise variance. The root η is the estimated noise variance. The term E_j, the
contribution of unit noise to var F_j, removes the bias on short arcs. For one marker in a plane the
center equals the center of the Hyper fit
(Al-Sharadqah and Chernov 2009; Kanatani and Rangarajan 2011). For spheres the center is the limit
of the iteration of Halvorsen 2003.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation.spatial._sphere_sums import SphereSums


_STEPS = 40
_REWEIGHED = 6
_NOTHING_M2 = 1e-18
"""Variance below which noise counts as a rounding error, m². It is one nanometer squared."""
_REACH_M = 1e3


@dataclass(frozen=True, slots=True)
class MarkerPaths:
    """Central moments of the paths of k markers in r directions."""

    n: Array
    """Effective number of frames of each marker, shape (k,)."""
    mean: Array
    """Mean of each path, m, shape (k, r)."""
    C: Array
    """Covariance of the positions x of each path, m², shape (k, r, r)."""
    c: Array
    """Covariance of x with |x|², m³, shape (k, r)."""
    Z: Array
    """Variance of |x|², m⁴, shape (k,)."""
    S: Array
    """Contribution of unit noise to `C`, shape (k, r, r); the identity for isotropic noise."""

    def seen_along(self, basis: Array) -> MarkerPaths:
        """Return the paths projected onto the columns of `basis`, shape (r, s)."""
        B = basis
        return MarkerPaths(
            self.n, self.mean @ B, B.T @ self.C @ B, self.c @ B, self.Z, B.T @ self.S @ B
        )


def paths_of(sums: SphereSums, shape: Array | None = None) -> MarkerPaths:
    """Return the central moments of the marker paths from centered sums.

    Parameters
    ----------
    sums : SphereSums
        Sums, centered about the mean of each marker.
    shape : ndarray, shape (k, d, d), optional
        Covariance of each marker's noise relative to the common variance; the identity if None.
    """
    k, d = sums.origin.shape
    own = np.einsum("jajb->jab", sums.M) / np.maximum(sums.weights, 1e-300)[:, None, None]
    Z = np.maximum(own[:, 0, 0] - own[:, 0, -1] ** 2, 0.0)
    S = np.tile(np.eye(d), (k, 1, 1)) if shape is None else np.asarray(shape, dtype=np.float64)

    return MarkerPaths(sums.counts, sums.origin, own[:, 1:-1, 1:-1], own[:, 0, 1:-1], Z, S)


@dataclass(frozen=True, slots=True)
class ConcentricSpheres:
    """Common center of several markers, with the noise and the radius of each marker."""

    center: Array
    """Common center, m, shape (r,)."""
    noise2: float
    """Unbiased variance of a coordinate of a marker with the relative noise 1, m²."""
    relative: Array
    """Noise variance of each marker divided by the common variance, shape (k,)."""
    radii2: Array
    """Squared radius of each marker, m², shape (k,)."""
    information: Array
    """Squared change of the directions from the center to the markers, summed over frames and
    markers, minus the contribution of noise, shape (r, r). The weight of a marker in the sum is the
    ratio of the common noise variance to the noise variance of the marker.
    """
    floor: Array
    """Contribution of noise to the sum in `information`, shape (r, r)."""


def common_center(paths: MarkerPaths) -> ConcentricSpheres | None:
    """Fit one center, with markers weighted by their noise; None if the paths have no curvature."""
    k = len(paths.n)
    relative = np.ones(k)
    found = _smallest_root(paths, relative)

    for _ in range(_REWEIGHED if k > 1 else 0):
        if found is None:
            return None

        # Compute the relative noise variance of each marker. Insignificant differences between
        # markers are reduced to zero.
        ratio = found[2] / np.maximum(relative * found[1], _NOTHING_M2) * relative
        ratio = ratio / np.median(ratio) if np.median(ratio) > 0 else np.ones_like(ratio)
        ratio = np.clip(ratio, 0.0, 1e6)
        chance = 4.0 * 2.0 / np.maximum(paths.n, 1.0)
        excess = (ratio - 1.0) ** 2
        trust = np.maximum(0.0, 1.0 - chance / np.maximum(excess, 1e-300))
        again = np.maximum(1.0 + trust * (ratio - 1.0), 0.05)

        done = bool(np.allclose(again, relative, rtol=0.02))
        relative = again
        if done:
            break
        found = _smallest_root(paths, relative)

    if found is None:
        return None
    m, eta, _, R2 = found
    total = float(paths.n.sum())
    noise2 = max(eta, _NOTHING_M2) * total / max(total - k - len(m), 1.0)
    w = paths.n / (R2 * relative)

    # relative to its mean over n frames, a path contains the fraction 1 - 1/n of the noise variance
    left = (1.0 - 1.0 / np.maximum(paths.n, 1.0)) * noise2 * relative
    floor = np.einsum("j,jab->ab", w * left, paths.S)
    information = np.einsum("j,jab->ab", w, paths.C) - floor
    return ConcentricSpheres(m, noise2, relative, R2, information, floor)


def _smallest_root(paths: MarkerPaths, relative: Array) -> tuple[Array, float, Array, Array] | None:
    """Return center, η, and the radial variance and the squared radius of each marker.

    G is the sum that vanishes at the root η, and B the normal matrix of the center at η. Newton's
    method is applied to G(η) det B(η), whose smallest root is η. From zero it converges without
    overshoot. Newton's method on G alone would overshoot on short arcs, because G is concave and B
    nearly singular.
    """
    g = np.average(paths.mean, axis=0, weights=paths.n)
    h = paths.mean - g
    S = paths.S * relative[:, None, None]
    trS, trSS = np.einsum("jaa->j", S), np.einsum("jab,jba->j", S, S)
    trSC, z0 = np.einsum("jab,jba->j", S, paths.C), np.einsum("jaa->j", paths.C)
    eta, R2 = 0.0, np.ones(len(h))
    m, V, added = g, np.zeros(len(h)), np.ones(len(h))

    for _ in range(_STEPS):
        w = paths.n / (R2 * relative)
        D = paths.C - eta * S
        B = np.einsum("j,jab->ab", w, D)
        try:
            inverse = np.linalg.inv(B)
        except np.linalg.LinAlgError:
            return None

        m = inverse @ (w @ (np.einsum("jab,jb->ja", D, h) + paths.c / 2.0))
        a = m - h
        q = np.einsum("ja,ja->j", a, a)
        if not np.isfinite(q).all() or q.max() > _REACH_M**2:
            return None
        V = 4.0 * (np.einsum("ja,jab,jb->j", a, paths.C, a) - (a * paths.c).sum(axis=1)) + paths.Z
        aSa = np.einsum("ja,jab,jb->j", a, S, a)
        R2 = np.maximum(q + z0 - eta * trS, 1e-8)
        added = 4.0 * (aSa + trSC) - 4.0 * eta * trSS
        G = float(w @ (V - eta * (added + 2.0 * eta * trSS)))
        slope = float(w @ added) + G * float(np.trace(inverse @ np.einsum("j,jab->ab", w, S)))
        step = G / slope if slope > 0.0 else 0.0
        eta += step
        if abs(step) <= 1e-13 * eta + 1e-30:
            break

    return (
        np.asarray(m + g),
        max(eta, 0.0),
        np.maximum(V, 0.0) / np.maximum(added, 1e-300) * relative,
        R2,
    )
