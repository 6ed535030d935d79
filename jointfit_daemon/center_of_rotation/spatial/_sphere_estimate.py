"""Center estimates from sums of marker positions: covariance, hinge axis and acceptance.

The movement of a hinge determines the center in two directions, and the axis of the hinge. A
straight path or a marker at rest is refused with a remedy. The caller determines the position of
the center along an unobserved direction.
"""

from __future__ import annotations

from dataclasses import replace
from math import degrees, inf
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation._path_statistics import arc_of
from jointfit_daemon.center_of_rotation._result import (
    CenterEstimate,
    name_flagged_markers,
    refusal,
)
from jointfit_daemon.center_of_rotation.spatial._concentric_spheres import paths_of
from jointfit_daemon.center_of_rotation.spatial._observability import (
    MIN_CONDITIONING,
    SphereLimits,
    moving_directions,
    observe,
)
from jointfit_daemon.center_of_rotation.spatial._sphere_sums import center_sums

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation.spatial._concentric_spheres import (
        ConcentricSpheres,
        MarkerPaths,
    )
    from jointfit_daemon.center_of_rotation.spatial._observability import ObservedCenter
    from jointfit_daemon.center_of_rotation.spatial._sphere_sums import SphereSums


MIN_FRAMES = 15
"""Smallest effective number of visible frames of a usable marker."""
LOUD = 9.0
"""Ratio of a marker's noise variance to the median of all markers, above which the marker is
flagged as noisy.
"""
PERSISTENT = 0.5
"""Lag-one autocorrelation of the residuals above which ``residuals_persist`` is set."""
STRAIGHT = "the marker paths have no curvature: move the joint by at least 30° in each direction"
FURTHER = ": increase the range of motion of this joint"
SOFT_TISSUE = (
    ", because soft-tissue artefact moves the markers off their spheres: move slowly, further and "
    "in more directions, or place the markers where the skin slides least; for a hinge use sara"
)
STILL = "the markers did not move relative to the parent: move the joint, at least 30° each way"


def center_of(
    sums: SphereSums,
    *,
    method: str = "running_sphere",
    near: Array | None = None,
    shape: Array | None = None,
    limits: SphereLimits | None = None,
) -> tuple[CenterEstimate, ConcentricSpheres | None]:
    """Estimate the center from sums over frames, and check whether it may be used.

    Parameters
    ----------
    sums : SphereSums
        Sums over any number of frames; the fixed point of each marker is arbitrary.
    method : str
        Method name stored in the result.
    near : ndarray, shape (d,), optional
        Position of the center along unobserved directions, m; the mean of the markers if None.
    shape : ndarray, shape (k, d, d), optional
        Noise covariance of each marker relative to the common variance; isotropic noise if None.
        For a moving parent, `_parent_frame_noise.relative` returns these covariances.
    limits : SphereLimits, optional
        Acceptance limits.

    Returns
    -------
    estimate : CenterEstimate
        Estimate of the center, which is NaN if the data were refused before the fit. The radius is
        NaN for markers that are visible in too few frames.
    spheres : ConcentricSpheres or None
        Fitted spheres of the markers. None if the data were refused before the fit, or if
        soft-tissue artefact hides a direction of the fit.
    """
    limits = limits or SphereLimits()
    d = sums.origin.shape[1]
    usable = sums.counts >= MIN_FRAMES
    if not usable.any():
        reason = f"{sums.frames} usable frames, at least {MIN_FRAMES} are needed"
        return refusal(method, d, sums.frames, f"{reason}: keep the markers visible"), None

    sums = center_sums(sums.only(usable))
    paths = paths_of(sums, None if shape is None else shape[usable])
    basis = moving_directions(paths)
    if basis.shape[1] == 0:
        return refusal(method, d, sums.frames, STILL), None
    seen = observe(sums, paths, basis, limits)
    if seen is None:
        return refusal(method, d, sums.frames, STRAIGHT), None
    found = _answer(sums, paths, seen, near, limits)
    found = name_flagged_markers(found, [str(j) for j in np.flatnonzero(usable)])
    radii = np.full(len(usable), np.nan)
    radii[usable] = found.radii
    whole = seen.shown.shape[0] == seen.shown.shape[1]

    return replace(found, method=method, radii=radii), seen.found if whole else None


def _answer(
    sums: SphereSums,
    paths: MarkerPaths,
    seen: ObservedCenter,
    near: Array | None,
    limits: SphereLimits,
) -> CenterEstimate:
    basis, found = seen.basis @ seen.shown, seen.found
    middle = np.average(paths.mean, axis=0, weights=paths.n)
    unseen = np.asarray(np.linalg.svd(basis)[0][:, basis.shape[1] :].T)
    stay = middle if near is None else np.asarray(near, dtype=np.float64)
    center, spread = shrink_center(seen, middle @ seen.basis)
    fitted = seen.basis @ center
    hidden = unseen @ seen.basis @ seen.basis.T  # directions in the fit that the result excludes
    lean = float(((unseen @ stay - hidden @ fitted - (unseen - hidden) @ middle) ** 2).sum())
    spread = seen.shown.T @ spread @ seen.shown
    C = basis @ (spread + lean * (seen.shown.T @ seen.tilt @ seen.shown)) @ basis.T

    # radii and arc are computed about the observable part of the center
    away = found.center - seen.paths.mean
    inside = away @ seen.shown
    aside2 = np.maximum((away**2).sum(axis=1) - (inside**2).sum(axis=1), 0.0)
    radii = np.sqrt(np.maximum(found.radii2 - aside2, 1e-8))
    arc = arc_of(float((np.linalg.norm(inside, axis=1) / radii).min()))
    radius = float(np.median(radii))
    conditioning = radius / float(np.sqrt(max(np.linalg.eigvalsh(spread)[-1], 1e-300)))
    relative, rho = found.relative, seen.left.persistence
    residual2 = np.maximum(np.diagonal(seen.left.together), 0.0)
    loud = np.flatnonzero(relative > LOUD * np.median(relative))
    flags = ["hinge"] if len(unseen) else []
    flags += ["residuals_persist"] if rho > PERSISTENT else []
    flags += ["residuals_repeat"] if seen.left.posture > 0.0 else []
    flags += [f"noisy_marker:{j}" for j in loud]

    return CenterEstimate(
        method="",
        center=basis @ (basis.T @ fitted) + unseen.T @ (unseen @ stay),
        covariance=(C + C.T) / 2.0,
        noise=float(np.sqrt(found.noise2 * np.median(relative))),
        residual=float(np.sqrt(np.average(residual2, weights=paths.n))),
        radii=radii,
        arc=arc,
        bound=float(np.sqrt(seen.bound2)) if len(unseen) == 0 else inf,
        conditioning=conditioning,
        frames=sums.frames,
        effective_frames=float(paths.n.mean()) * (1 - rho) / (1 + rho),
        unseen=unseen,
        axis=unseen[0] if len(unseen) == 1 and len(basis) == 3 else None,
        flags=tuple(flags),
        within95=seen.within95,
        refused=objection(arc, radius, conditioning, limits, soft_tissue=seen.left.posture > 0.0),
    )


def shrink_center(seen: ObservedCenter, middle: Array) -> tuple[Array, Array]:
    r"""Return the center, shrunk towards the markers' mean, and its covariance.

    .. math:: S = (I + C/R^2)^{-1}, \qquad d' = S d, \qquad C' = S C S

    where d is the vector from the markers' mean to the center, with covariance C. The error of the
    estimated curvature is nearly normal. The inverse of the curvature, the distance, is therefore
    too large on average. The shrinkage is Zellner's minimum expected loss estimator of an inverse
    (1978). It removes this outward bias, as `temper` does for circles. On long arcs S is nearly the
    identity.
    """
    R2 = float(np.median(seen.found.radii2))
    S = np.linalg.inv(np.eye(len(middle)) + seen.spread / R2)
    return middle + S @ (seen.found.center - middle), S @ seen.spread @ S.T


def objection(
    arc: float,
    radius: float,
    conditioning: float,
    limits: SphereLimits,
    *,
    soft_tissue: bool = False,
) -> str | None:
    """Return the cause and the remedy if a center must not be used; None if it is usable."""
    if arc < limits.min_arc:
        return f"the joint turned {degrees(arc):.0f}°: move it through at least 30°"
    if not limits.reach[0] <= radius <= limits.reach[1]:
        return f"the markers would be {radius:.2f} m from the center: check marker names"
    if conditioning < MIN_CONDITIONING:
        remedy = SOFT_TISSUE if soft_tissue else FURTHER
        return (
            f"the standard deviation of the center is {1000 * radius / conditioning:.0f} mm{remedy}"
        )
    return None
