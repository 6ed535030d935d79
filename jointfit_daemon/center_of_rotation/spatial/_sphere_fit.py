"""Sphere fits of all frames at once.

`fit_sphere` is robust and is the recommended method. The linear fits are for comparison. Invariant:
a `RunningSphere` that processed the same frames accepts or refuses the same centers.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation._path_statistics import radial_residuals
from jointfit_daemon.center_of_rotation._result import refusal
from jointfit_daemon.center_of_rotation.spatial._concentric_spheres import paths_of
from jointfit_daemon.center_of_rotation.spatial._geometric_solver import SphereOptions, solve_sphere
from jointfit_daemon.center_of_rotation.spatial._observability import SphereLimits
from jointfit_daemon.center_of_rotation.spatial._parent_frame_noise import relative
from jointfit_daemon.center_of_rotation.spatial._sphere_estimate import MIN_FRAMES, center_of
from jointfit_daemon.center_of_rotation.spatial._sphere_sums import center_sums, sum_up

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation._result import CenterEstimate


OUTLIER = 3.0
"""Residual in standard deviations above which the weight of a point is reduced. Noise rarely
exceeds this threshold, so the noise variance is not underestimated.
"""
STILL_M = 1e-6
_HALVORSEN_STEPS = 20
FLAT = (
    "the markers moved about one axis or not at all, so this method finds no center: move in "
    "more directions, or use sphere, which also finds a hinge"
)


def gamage_lasenby(points: Array, min_direction: float = 0.0) -> CenterEstimate:
    r"""Solve for the center with the smallest variance of squared distances.

    .. math:: 2 \sum_j \left(\overline{vv^T} - \bar v \bar v^T\right) m
              = \sum_j \left(\overline{v|v|^2} - \bar v\, \overline{|v|^2}\right)

    where v are the positions of marker j and m is the center. On short arcs the center is biased
    towards the markers, as in the circle fit of Kåsa. Source: Gamage and Lasenby 2002.

    Parameters
    ----------
    points : ndarray, shape (n, k, 3)
        Markers of the child in the parent's coordinates, m; NaN where not seen.
    min_direction : float
        RMS rotation, rad, below which a direction is unobserved and the estimate is refused.
    """
    return _linear(points, "gamage_lasenby", 0, min_direction)


def halvorsen(points: Array, min_direction: float = 0.0) -> CenterEstimate:
    r"""Estimate the center of `gamage_lasenby`, corrected for noise bias in twenty iterations.

    .. math:: A m = b - 2 σ^2 \sum_j (\bar v_j - m), \qquad
              σ^2 = \frac{\sum (u - \bar u_j)^2}{nk - k - 3}, \quad u = |v - m|

    where A and b are the matrix and the right-hand side of `gamage_lasenby`, n is the number of
    frames and k the number of markers. Source: Halvorsen 2003. The parameters have the same meaning
    as in `gamage_lasenby`.
    """
    return _linear(points, "halvorsen", _HALVORSEN_STEPS, min_direction)


def _linear(points: Array, method: str, steps: int, min_direction: float) -> CenterEstimate:
    estimate, _ = center_of(
        sum_up(points), method=method, limits=SphereLimits(min_direction=min_direction)
    )
    if len(estimate.unseen) > 0:
        why = FLAT if estimate.refused is None else estimate.refused
        return refusal(method, 3, estimate.frames, why)

    used = np.isfinite(estimate.radii)
    points = points[:, used]
    seen = np.asarray(np.isfinite(points).all(axis=-1))
    paths = paths_of(center_sums(sum_up(points)))
    A = paths.C.sum(axis=0)
    b = np.einsum("jab,jb->a", paths.C, paths.mean) + paths.c.sum(axis=0) / 2.0
    m = np.linalg.solve(A, b)

    for _ in range(steps):
        e, _ = radial_residuals(points, m, seen.astype(np.float64))
        noise2 = float((e[seen] ** 2).sum()) / max(int(seen.sum()) - len(paths.n) - 3, 1)
        m = np.linalg.solve(A, b - noise2 * (paths.mean - m).sum(axis=0))

    flags = estimate.flags if steps else (*estimate.flags, "biased_on_short_arcs")
    return replace(estimate, center=m, flags=flags)


def fit_sphere(
    points: Array,
    options: SphereOptions | None = None,
    limits: SphereLimits | None = None,
    parent: Array | None = None,
) -> CenterEstimate:
    r"""Fit the point at a constant distance from each marker.

    .. math:: \min_m \sum_{tj} \rho\left(|v_{tj} - m| - \bar u_j\right),
              \qquad \bar u_j = \mathrm{mean}_t |v_{tj} - m|

    ρ is the Huber loss. This fit determines the weights of outliers. Center and covariance are then
    computed from weighted sums over all points.

    Parameters
    ----------
    points : ndarray, shape (n, k, 3)
        Markers of the child in the parent's coordinates, m; NaN where not seen.
    options : SphereOptions, optional
        Start value and robustness of the fit.
    limits : SphereLimits, optional
        Acceptance limits.
    parent : ndarray, shape (m, 3), optional
        Markers of the parent in the parent's coordinates, m. Their noise is common to all markers
        of the child, and is separated from the noise of the child's markers.

    Returns
    -------
    CenterEstimate
        Estimate; `unseen` contains the unobserved directions, such as the axis of a hinge. Along
        these directions the center is at `options.start`, or at the mean of the markers.
    """
    options = options or SphereOptions()
    weights = _weights(points, options)
    sums, near = sum_up(points, weights), options.start
    found, _ = center_of(sums, method="sphere", near=near, limits=limits)
    if parent is None or not np.isfinite(found.center).all():
        return found
    shape = relative(points, parent, found.center)
    return center_of(sums, method="sphere", near=near, shape=shape, limits=limits)[0]


def _weights(points: Array, options: SphereOptions) -> Array | None:
    """Return the weight of each marker in each frame, shape (n, k); None if all are one."""
    seen = np.asarray(np.isfinite(points).all(axis=-1))
    enough = seen.sum(axis=0) >= MIN_FRAMES
    still = not enough.any() or float(np.nanstd(points[:, enough], axis=0).max()) < STILL_M
    if still or not np.isfinite(options.huber):
        return None
    fit = solve_sphere(points[:, enough], options)
    if fit.basis.shape[1] < 2:
        return None
    e = np.abs(fit.residuals)
    scale = max(1.4826 * float(np.median(e[fit.seen])), options.smallest_scale)
    weights = np.ones(seen.shape)
    weights[:, enough] = np.minimum(1.0, OUTLIER * scale / np.maximum(e, 1e-12))

    return weights
