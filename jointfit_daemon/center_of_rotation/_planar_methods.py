"""Planar methods for any number of markers, in a plane or in space.

Points in space are projected along the joint axis, which is given or estimated from the paths. A
movement about more than one axis is refused. The position of the center along the axis is reported
as unseen.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation._fused_estimate import fuse_centers
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
    from collections.abc import Callable

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation._movement import Movement
    from jointfit_daemon.center_of_rotation._result import CenterEstimate
    from jointfit_daemon.center_of_rotation.planar import CircleMethod


OFF_AXIS = (
    "the marker paths are not planar, so the joint rotated about more than one axis: use sphere "
    "or score, or give the axis"
)
LIMITS = CircleLimits(sd=inf)
"""No limit on the error: a user who chose a method gets its result with its uncertainty."""
_GRID_STEP_M = 0.005


def circle(method: CircleMethod) -> Callable[[Array, Movement], CenterEstimate]:
    """Return a closed-form fit as a function of points, shape (n, k, 2)."""
    return lambda points, _: _each(
        points, lambda p: circle_estimate(p, method=method, limits=LIMITS)
    )


def geometric(points: Array, movement: Movement) -> CenterEstimate:
    """Fit all markers' circles at once, by distance."""
    start = movement.near if movement.near is not None and len(movement.near) == 2 else None
    return geometric_estimate(points, start=start, limits=LIMITS)


def running(points: Array, _: Movement) -> CenterEstimate:
    """Feed each marker to a stream of its own."""

    def one(p: Array) -> CenterEstimate:
        stream = RunningCircle(limits=LIMITS)
        for x, y in p:
            stream.feed(float(x), float(y))
        return replace(stream.estimate(), method="running_circle")

    return _each(points, one)


def oriented(points: Array, movement: Movement) -> CenterEstimate:
    """Use the child's angle, too."""
    angles = movement.angles
    if angles is None:
        raise ValueError("oriented needs angles: of the child about the axis, rad")
    return _each(points, lambda p: oriented_estimate(p, angles, movement.interval, limits=LIMITS))


def grid(points: Array, _: Movement) -> CenterEstimate:
    """Search grid nodes around the circle fit; a baseline, no better than its step."""

    def one(p: Array) -> CenterEstimate:
        about = circle_estimate(p, limits=LIMITS)
        if about.refused is not None:
            return replace(about, method="grid")
        seen = p[np.isfinite(p).all(axis=1)]
        x, y = (float(v) for v in np.round(about.center / _GRID_STEP_M) * _GRID_STEP_M)
        node = grid_center(seen, Grid((x, y), step=_GRID_STEP_M))
        rounding = _GRID_STEP_M**2 / 12.0 * np.eye(2)

        return replace(about, method="grid", center=node, covariance=about.covariance + rounding)

    return _each(points, one)


def three_frames(points: Array, _: Movement) -> CenterEstimate:
    """Use the first, middle and last frame, with the noise that all frames show."""

    def one(p: Array) -> CenterEstimate:
        whole = circle_estimate(p, limits=LIMITS)
        if whole.refused is not None:
            return replace(whole, method="three_frames")
        seen = p[np.isfinite(p).all(axis=1)]
        # along the arc, not along time: a movement may end where it began
        turn = np.unwrap(np.arctan2(*(seen - whole.center).T[::-1]))
        order = np.argsort(turn)
        middle = int(np.argmin(np.abs(turn - turn[order[[0, -1]]].mean())))

        return three_frame_estimate(seen[[order[0], middle, order[-1]]], whole.noise)

    return _each(points, one)


def _each(points: Array, one: Callable[[Array], CenterEstimate]) -> CenterEstimate:
    """Fit every marker alone and fuse."""
    found = [one(points[:, j]) for j in range(points.shape[1])]
    if len(found) == 1:
        return found[0]
    fused = fuse_centers(found)
    return replace(fused, method=found[0].method)


def in_plane(
    run: Callable[[Array, Movement], CenterEstimate], name: str
) -> Callable[[Movement], CenterEstimate]:
    """Return a planar method that takes points in space, too."""

    def of(movement: Movement) -> CenterEstimate:
        points = movement.points
        if points is None:
            raise ValueError(f"{name} needs points")
        if points.shape[-1] == 2:
            return run(points, movement)
        axis = movement.axis
        if axis is None:
            turn = SphereLimits(min_direction=movement.least_turn)
            shown = fit_running(points, limits=turn)
            if shown.axis is None:
                return refusal(name, 3, shown.frames, shown.refused or OFF_AXIS)
            axis = shown.axis

        plane = plane_of(axis)
        return _lifted(run(points @ plane, movement), plane, points, movement.near)

    return of


def _lifted(
    found: CenterEstimate, plane: Array, points: Array, near: Array | None
) -> CenterEstimate:
    """Write a center in a plane as a line in space."""
    axis = np.cross(plane[:, 0], plane[:, 1])
    if found.refused is not None and len(found.unseen):
        return replace(refusal(found.method, 3, found.frames, found.refused), flags=found.flags)
    stay = np.nanmean(points, axis=(0, 1)) if near is None else near
    return replace(
        found,
        center=plane @ found.center + axis * (axis @ stay),
        covariance=plane @ found.covariance @ plane.T,
        bound=inf,
        unseen=axis[None],
        axis=axis,
        flags=(*found.flags, "hinge"),
    )
