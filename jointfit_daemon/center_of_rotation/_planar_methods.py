"""Planar methods for any number of markers, in a plane or in space.

Points in space are projected along the joint axis, which is given or estimated from the paths. A
movement about more than one axis is refused. The position of the center along the axis is reported
as unobserved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING, cast

import numpy as np

from jointfit_daemon.arrays import Array
from jointfit_daemon.center_of_rotation._fused_estimate import fuse_centers
from jointfit_daemon.center_of_rotation._movement import Movement
from jointfit_daemon.center_of_rotation._result import refusal
from jointfit_daemon.center_of_rotation.planar import (
    CircleLimits,
    Grid,
    RunningCircle,
    circle_estimate,
    geometric_estimate,
    grid_center,
    oriented_estimate,
    plane_of,
    three_frame_estimate,
)
from jointfit_daemon.center_of_rotation.spatial import SphereLimits, fit_running

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.center_of_rotation._result import CenterEstimate
    from jointfit_daemon.center_of_rotation.planar import CircleMethod

MarkerFit = Callable[[Array, Movement], "CenterEstimate"]
"""Function that estimates a center in a plane. Its arguments are points and a movement. The points,
m, have the shape (n, 2) for one marker, or (n, k, 2) for k markers.
"""

OFF_AXIS = (
    "the marker paths are not planar, so the joint rotated about more than one axis: use sphere "
    "or score, or give the axis"
)
LIMITS = CircleLimits(rms_error=inf)
"""Acceptance limits without a limit on the error. The user selected the method, so a center with a
large error is returned, with its uncertainty.
"""
_GRID_STEP_M = 0.005


def circle(method: CircleMethod) -> MarkerFit:
    """Return the function that fits a circle to the path of one marker in closed form."""
    return lambda p, _: circle_estimate(p, method=method, limits=LIMITS)


def running(p: Array, _: Movement) -> CenterEstimate:
    """Estimate the center with `RunningCircle` from the positions of one marker, frame by frame."""
    stream = RunningCircle(limits=LIMITS)
    for x, y in p.tolist():
        stream.feed(x, y)
    return replace(stream.estimate(), method="running_circle")


def fit_oriented(p: Array, movement: Movement) -> CenterEstimate:
    """Fit the path of one marker together with the child's angle."""
    angles = cast("Array", movement.angles)  # `METHODS` requires the angles for this method
    return oriented_estimate(p, angles, movement.interval, limits=LIMITS)


def grid(p: Array, _: Movement) -> CenterEstimate:
    """Return the best node of a grid around the circle fit of one marker.

    The other planar methods are compared to this method.
    """
    about = replace(circle_estimate(p, limits=LIMITS), method="grid")
    if about.refused is not None:
        return about
    seen = p[np.isfinite(p).all(axis=1)]
    x, y = (float(v) for v in np.round(about.center / _GRID_STEP_M) * _GRID_STEP_M)
    node = grid_center(seen, Grid((x, y), step=_GRID_STEP_M))
    rounding = _GRID_STEP_M**2 / 12.0 * np.eye(2)
    return replace(about, center=node, covariance=about.covariance + rounding)


def three_frames(p: Array, movement: Movement) -> CenterEstimate:
    """Estimate the center from three frames of one marker.

    The method uses the frames with the first, the middle and the last position on the arc. The
    noise is estimated from all frames. If the optical system reports a residual for every position,
    the noise of a frame is proportional to its residual.
    """
    whole = circle_estimate(p, limits=LIMITS)
    if whole.refused is not None:
        return replace(whole, method="three_frames")
    visible = np.asarray(np.isfinite(p).all(axis=1))
    seen = p[visible]
    # Frames are ordered along the arc, not in time, because a movement may end where it began.
    turn = np.unwrap(np.arctan2(*(seen - whole.center).T[::-1]))
    order = np.argsort(turn)
    middle = int(np.argmin(np.abs(turn - turn[order[[0, -1]]].mean())))
    chosen = [order[0], middle, order[-1]]
    noise = whole.noise * _relative_noise(movement.residuals, visible)[chosen]
    found = three_frame_estimate(seen[chosen], noise[:, None])
    return replace(found, bound=whole.bound)  # the Cramér-Rao bound for all frames


def _relative_noise(residuals: Array | None, visible: NDArray[np.bool_]) -> Array:
    """Return the noise of each visible frame of one marker, relative to the RMS of these frames."""
    if residuals is None:
        return np.ones(int(visible.sum()))
    stated = residuals[visible, 0]
    known = np.isfinite(stated)
    typical = np.sqrt(np.mean(stated[known] ** 2)) if known.any() else 1.0
    return np.where(known, stated, typical) / typical


def geometric(points: Array, movement: Movement) -> CenterEstimate:
    """Fit circles about one center to all markers at once, with radial residuals."""
    start = movement.near if movement.near is not None and len(movement.near) == 2 else None
    return geometric_estimate(points, start=start, limits=LIMITS)


def each(fit: MarkerFit) -> MarkerFit:
    """Return a function that fits each marker separately and fuses the centers."""

    def fit_all(points: Array, movement: Movement) -> CenterEstimate:
        stated = movement.residuals
        found = [
            fit(
                points[:, j],
                movement if stated is None else replace(movement, residuals=stated[:, j : j + 1]),
            )
            for j in range(points.shape[1])
        ]
        return found[0] if len(found) == 1 else replace(fuse_centers(found), method=found[0].method)

    return fit_all


def fit_in_plane(name: str, fit: MarkerFit, movement: Movement, points: Array) -> CenterEstimate:
    """Run a planar method on points in a plane, shape (n, k, 2), or in space, shape (n, k, 3)."""
    if points.shape[-1] == 2:
        return fit(points, movement)

    axis = movement.axis
    if axis is None:
        shown = fit_running(points, limits=SphereLimits(min_direction=movement.least_turn))
        if shown.axis is None:
            return refusal(name, 3, shown.frames, shown.refused or OFF_AXIS)
        axis = shown.axis
    plane = plane_of(axis)
    found = fit(points @ plane, movement)
    if found.refused is not None and len(found.unseen):
        return replace(refusal(found.method, 3, found.frames, found.refused), flags=found.flags)

    # a center in the plane is a line in space, and the position along this line is unobserved
    across = np.cross(plane[:, 0], plane[:, 1])
    stay = np.nanmean(points, axis=(0, 1)) if movement.near is None else movement.near
    return replace(
        found,
        center=plane @ found.center + across * (across @ stay),
        covariance=plane @ found.covariance @ plane.T,
        bound=inf,
        unseen=across[None],
        axis=across,
        flags=(*found.flags, "hinge"),
    )
