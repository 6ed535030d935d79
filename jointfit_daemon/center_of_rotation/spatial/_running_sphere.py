"""Center of rotation of several markers, updated frame by frame at constant cost.

Invariant: the result equals the batch fit of all frames with the same weights.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation.spatial._observability import SphereLimits
from jointfit_daemon.center_of_rotation.spatial._sphere_estimate import center_of
from jointfit_daemon.center_of_rotation.spatial._sphere_sums import (
    LAGS,
    SphereSums,
    center_sums,
    sum_up,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation._result import CenterEstimate
    from jointfit_daemon.center_of_rotation.spatial._concentric_spheres import ConcentricSpheres


OUTLIER = 3.0
"""Residual, in standard deviations, above which the weight of a marker is reduced. The threshold is
larger than the usual 1.5, because the weights of a frame are not revised later. With a smaller
threshold the estimated noise would decrease from frame to frame.
"""
OFF = 8.0
"""Residual, in standard deviations, above which a marker is off its sphere; it must also exceed
`OFF_M`.
"""
OFF_M = 0.01
STAYED_OFF = 25
"""Number of consecutive frames after which a marker that is off its sphere is restarted at its new
position.
"""
_FAR_M = 2.0
"""Largest distance, m, of a marker from its fixed point, which is its first visible position.
Fourth powers of larger distances lose digits.
"""


@dataclass(frozen=True, slots=True)
class _ExpectedMarkers:
    """Marker positions expected from the last estimate."""

    f: Array
    """Coefficients f of the radial residual f·φ of each marker, shape (k, e); zero for a marker
    without estimate. With the marker position p relative to its fixed point, φ = (p², p, 1), and
    e = d + 2. The residual is in m.
    """
    noise: Array
    """Standard deviation of a coordinate of each marker, m, shape (k,); inf where unknown."""
    mean: Array
    """Mean path position of each marker relative to the fixed point of the marker, m, shape (k,
    d)."""
    unsure: Array
    """Covariance of the center divided by the squared radius of each marker, shape (k, d, d)."""


class RunningSphere:
    """Center of rotation of several markers, updated frame by frame.

    Parameters
    ----------
    markers : int
        Number of markers k in a frame.
    forgetting : float
        Factor by which the weight of all earlier frames is multiplied at each new frame, in (0, 1];
        1 disables forgetting.
    dimension : int
        Dimension of the points: 3, or 2 in a plane.
    near : ndarray, shape (dimension,), optional
        Position of the center along unobserved directions, m; the mean of the markers if None.
    robust : bool
        Whether to reduce the weight of markers that leave their sphere because of soft-tissue
        artefact or exchanged labels. The sums of a marker that remains off its sphere are then
        reset. The last call of `estimate` determines the spheres.
    limits : SphereLimits, optional
        Acceptance limits. If None, persistent residuals are not counted as soft-tissue artefact,
        and the caller adds the variance of the artefact. Pass ``SphereLimits()`` to count the
        artefact here.
    shape : ndarray, shape (k, d, d), optional
        Covariance of each marker's noise relative to the common variance, as returned by
        `_parent_frame_noise.relative`; isotropic noise if None.

    Raises
    ------
    ValueError
        There are no markers, `forgetting` is outside (0, 1], or `dimension` is neither 2 nor 3.
    """

    def __init__(
        self,
        markers: int,
        *,
        forgetting: float = 1.0,
        dimension: int = 3,
        near: Array | None = None,
        robust: bool = True,
        limits: SphereLimits | None = None,
        shape: Array | None = None,
    ) -> None:
        if markers < 1 or not 0.0 < forgetting <= 1.0 or dimension not in {2, 3}:
            raise ValueError(
                f"markers {markers}, forgetting {forgetting}, dimension {dimension}: at least one "
                "marker, forgetting above 0 and at most 1, in a plane or in space"
            )

        e = dimension + 2
        self._near, self._robust, self._shape = near, robust, shape
        self._limits = limits or SphereLimits(posture=False)
        self._forgetting = forgetting
        self._origin = np.full((markers, dimension), np.nan)
        self._M = np.zeros((markers * e, markers * e))
        self._L = np.zeros((len(LAGS), markers, e, e))
        self._squares = np.zeros(markers)
        self._phi = np.zeros((markers, e))
        self._phi[:, -1] = 1.0
        self._past = deque((np.zeros((markers, e)) for _ in range(LAGS[-1])), maxlen=LAGS[-1])
        self._frames = 0
        self._placed = False
        self._expected: _ExpectedMarkers | None = None
        self._off = np.zeros(markers, dtype=np.int64)
        self._restarted: set[int] = set()

    def feed(self, points: Array, weights: Array | None = None) -> None:
        """Process the marker positions of one frame.

        Parameters
        ----------
        points : ndarray, shape (k, d)
            Markers in the parent's coordinates, m; NaN where missing.
        weights : ndarray, shape (k,), optional
            Weight of each marker, non-negative; one if None.
        """
        if not self._placed:
            self._place(points)
        phi = self._phi
        p = phi[:, 1:-1]
        np.subtract(points, self._origin, out=p)
        np.einsum("ja,ja->j", p, p, out=phi[:, 0])
        w = self._weights(weights)
        if w is not None:
            phi = np.where(w[:, None] > 0.0, phi, 0.0) * np.sqrt(w)[:, None]
        flat = phi.reshape(-1)
        if self._forgetting < 1.0:
            self.fade(self._forgetting)

        self._M += flat[:, None] * flat
        for g, lag in enumerate(LAGS):
            self._L[g] += phi[:, :, None] * self._past[-lag][:, None, :]
        self._squares += 1.0 if w is None else w * w
        self._past.append(phi.copy())
        self._frames += 1 if w is None else int(w.any())

    def fade(self, share: float) -> None:
        """Multiply the weights of all frames that were processed by a factor between 0 and 1."""
        self._M *= share
        self._L *= share
        self._squares *= share**2

    def sums(self) -> SphereSums:
        """Return the sums over all frames."""
        k, e = self._phi.shape
        origin = np.where(np.isfinite(self._origin), self._origin, 0.0)
        M = self._M.reshape(k, e, k, e).copy()
        return SphereSums(origin, M, self._L.copy(), self._squares.copy(), self._frames)

    def estimate(self) -> CenterEstimate:
        """Return center, covariance and predicted error of all frames; never raise an error.

        This method takes longer than `feed`. Call it when a result is published, not in every
        frame.
        """
        sums = self.sums()
        found, spheres = center_of(sums, near=self._near, shape=self._shape, limits=self._limits)
        if self._robust:
            known = spheres is not None and found.refused is None
            self._expected = _expect_markers(sums, found, spheres) if known and spheres else None

        flags = tuple(f"marker_moved:{j}" for j in sorted(self._restarted))
        return replace(found, flags=found.flags + flags) if flags else found

    def _place(self, points: Array) -> None:
        """Set the fixed point of every marker at its first visible position."""
        first = np.isnan(self._origin[:, 0]) & np.isfinite(points).all(axis=1)
        self._origin[first] = points[first]
        self._placed = bool(np.isfinite(self._origin).all())

    def _weights(self, given: Array | None) -> Array | None:
        """Return the marker weights of the frame stored in `_phi`; None if all weights are one."""
        phi, expected = self._phi, self._expected
        near = phi[:, 0] < _FAR_M**2  # False for NaN
        if expected is None:
            if given is None and near.all():
                return None
            w = np.where(near, 1.0 if given is None else given, 0.0)
            return self._restart(w, np.isfinite(phi[:, 0]) & ~near)

        residual = np.abs(np.einsum("ja,ja->j", expected.f, phi))
        fine = residual <= OUTLIER * expected.noise
        if given is None and (fine & near).all():
            self._off[:] = 0
            return None

        w = np.where(near, 1.0 if given is None else given, 0.0)
        if fine.all():
            return self._restart(w, np.isfinite(phi[:, 0]) & ~near)
        # The uncertainty of the center increases the tolerance of a marker far from its mean.
        way = np.where(near[:, None], phi[:, 1:-1] - expected.mean, 0.0)
        excused = np.einsum("ja,jab,jb->j", way, expected.unsure, way)
        scale = np.sqrt(expected.noise**2 + np.maximum(excused, 0.0))
        residual = np.where(near, residual, 0.0)
        w = w * np.minimum(1.0, OUTLIER * scale / np.maximum(residual, 1e-300))
        off = near & (residual > np.maximum(OFF * scale, OFF_M))

        return self._restart(w, off | (np.isfinite(phi[:, 0]) & ~near))

    def _restart(self, w: Array, off: NDArray[np.bool_]) -> Array:
        """Reset markers that remained off their sphere; return the weights without these markers.

        A marker remains off its sphere after it slipped, or after its label was exchanged.
        """
        self._off = np.where(off, self._off + 1, np.where(w > 0.0, 0, self._off))
        k, e = self._phi.shape
        for j in np.flatnonzero(self._off >= STAYED_OFF):
            M = self._M.reshape(k, e, k, e)
            M[j] = 0.0
            M[:, :, j] = 0.0
            self._L[:, j] = 0.0
            for past in self._past:
                past[j] = 0.0
            self._squares[j] = 0.0
            self._off[j] = 0
            self._origin[j] = np.nan
            self._placed = False
            self._restarted.add(int(j))
            if self._expected is not None:
                self._expected.f[j] = 0.0
                self._expected.noise[j] = np.inf

            w = np.where(np.arange(k) == j, 0.0, w)

        return w


def _expect_markers(
    sums: SphereSums, found: CenterEstimate, spheres: ConcentricSpheres
) -> _ExpectedMarkers:
    k, d = sums.origin.shape
    used = np.isfinite(found.radii)
    at = center_sums(sums)
    mean = np.where(used[:, None], at.origin - sums.origin, 0.0)
    across = np.eye(d) - found.unseen.T @ found.unseen
    a = (found.center - at.origin) @ across
    radii = np.where(used, found.radii, np.inf)
    z0 = np.einsum("jaa->j", at.M[:, 1:-1, :, 1:-1].diagonal(0, 0, 2).transpose(2, 0, 1))
    z0 = z0 / np.maximum(sums.weights, 1e-300)
    f = np.ones((k, d + 2))
    f[:, 1:-1] = -2.0 * (mean + a)
    f[:, -1] = (mean**2).sum(axis=1) + 2.0 * (a * mean).sum(axis=1) - z0
    noise = np.full(k, np.inf)
    noise[used] = np.sqrt(spheres.noise2 * spheres.relative)
    f = np.where(used[:, None], f / (2.0 * radii)[:, None], 0.0)

    return _ExpectedMarkers(f, noise, mean, found.covariance / (radii**2)[:, None, None])


def fit_running(
    points: Array,
    weights: Array | None = None,
    *,
    near: Array | None = None,
    limits: SphereLimits | None = None,
    shape: Array | None = None,
) -> CenterEstimate:
    """Return the estimate of `RunningSphere` for all frames at once.

    Parameters
    ----------
    points : ndarray, shape (n, k, d)
        Marker positions, m; NaN where a marker is not visible.
    weights : ndarray, shape (n, k), optional
        Weights of the markers, non-negative; one if None. For a result with forgetting, pass the
        final weights of the frames.
    near, limits, shape
        Parameters of `RunningSphere`.
    """
    limits = limits or SphereLimits(posture=False)
    return center_of(sum_up(points, weights), near=near, shape=shape, limits=limits)[0]
