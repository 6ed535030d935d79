"""Table of all estimators and one function that runs any of them.

`METHODS` lists the inputs that each method needs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import degrees, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation import _planar_methods
from jointfit_daemon.center_of_rotation._movement import Movement
from jointfit_daemon.center_of_rotation._result import refusal
from jointfit_daemon.center_of_rotation.spatial import (
    NOISE_FACTOR,
    RunningSphere,
    SphereLimits,
    SphereOptions,
    fit_axis,
    fit_score,
    fit_sphere,
    gamage_lasenby,
    halvorsen,
    turn_noise,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation._movement import BodyPoses
    from jointfit_daemon.center_of_rotation._result import CenterEstimate


_ASK_EVERY = 50
"""Frames between two estimates of a stream, which update its outlier weights."""


@dataclass(frozen=True, slots=True)
class EstimationMethod:
    """One estimator by name."""

    name: str
    about: str
    """One-line description."""
    needs: tuple[str, ...]
    """Fields of `Movement` that must be given: ``points``, ``parent`` and ``child``, ``angles``."""
    planar: bool
    """Works in a plane: points in space are projected along `Movement.axis`."""
    run: Callable[[Movement], CenterEstimate]


def estimate_center(movement: Movement | Array, method: str = "auto") -> CenterEstimate:
    """Estimate a center of rotation by any method.

    Parameters
    ----------
    movement : Movement or ndarray
        An array, shape (n, k, d) or (n, d), stands for `Movement` with these points only.
    method : str
        A key of `METHODS`, or ``auto``: ``sphere``; in a plane ``geometric``; ``score`` where there
        are no points but both bodies' poses.

    Returns
    -------
    CenterEstimate
        With `refused` set, naming cause and remedy, where the movement does not show a center.

    Raises
    ------
    ValueError
        Unknown method, or the movement lacks a required field. Bad data never raise.
    """
    if not isinstance(movement, Movement):
        movement = Movement(np.asarray(movement, dtype=np.float64))
    movement = _checked(movement)
    chosen = METHODS.get(_auto(movement) if method == "auto" else method)
    if chosen is None:
        raise ValueError(f"no method {method!r}; there are: {', '.join(sorted(METHODS))}")
    if missing := [name for name in chosen.needs if getattr(movement, name) is None]:
        raise ValueError(f"{chosen.name} needs {' and '.join(missing)}, which the movement lacks")
    points = movement.points if "points" in chosen.needs else None
    if points is not None and not chosen.planar and points.shape[-1] != 3:
        raise ValueError(f"{chosen.name} needs points in space, shape (n, k, 3)")
    if points is not None and not np.isfinite(points).any():
        reason = "all markers are missing in every frame: check marker names, cameras and occlusion"
        return refusal(chosen.name, points.shape[-1], 0, reason)

    return _beyond_parent(chosen.run(movement), movement.parent_markers)


def _beyond_parent(found: CenterEstimate, parent: Array | None) -> CenterEstimate:
    """Refuse a turn that the noise of the parent's own frame may be: the child need not move."""
    if parent is None or found.refused is not None or len(found.center) < 3:
        return found
    turn = sqrt(NOISE_FACTOR) * turn_noise(parent, found.noise)
    # directions spread evenly over an arc are a quarter of it away from their mean
    if found.arc / 4.0 > turn:
        return found
    why = (
        f"the joint turned {degrees(found.arc):.0f}°, which noise of the parent's markers may be: "
        "move it further, or put the parent's markers further apart"
    )
    return replace(found, refused=why)


def _checked(movement: Movement) -> Movement:
    points = movement.points
    if points is None:
        return movement
    points = np.asarray(points, dtype=np.float64)
    points = points[:, None] if points.ndim == 2 else points
    if points.ndim != 3 or points.shape[1] == 0 or points.shape[2] not in {2, 3}:
        raise ValueError(f"points have shape {points.shape}, expected (n, k, 2) or (n, k, 3)")
    whole = np.isfinite(points).all(axis=-1, keepdims=True)
    return replace(movement, points=np.where(whole, points, np.nan))


def _auto(movement: Movement) -> str:
    if movement.points is None:
        return "score"
    return "geometric" if movement.points.shape[-1] == 2 else "sphere"


def _points(movement: Movement) -> Array:
    if movement.points is None:
        raise ValueError("points are needed")
    return movement.points


def _bodies(movement: Movement) -> tuple[BodyPoses, BodyPoses]:
    if movement.parent is None or movement.child is None:
        raise ValueError("both bodies' poses are needed")
    return movement.parent, movement.child


def _stream(movement: Movement) -> CenterEstimate:
    points = _points(movement)
    limits = SphereLimits(min_direction=movement.least_turn)
    k, d = points.shape[1:]
    stream = RunningSphere(k, dimension=d, near=movement.near, limits=limits)
    for number, frame in enumerate(points, 1):
        stream.feed(frame)
        if number % _ASK_EVERY == 0:
            stream.estimate()
    return stream.estimate()


def _planar(
    name: str, about: str, run: Callable[[Array, Movement], CenterEstimate], *more: str
) -> EstimationMethod:
    return EstimationMethod(
        name, about, ("points", *more), True, _planar_methods.in_plane(run, name)
    )


_ALL = (
    _planar("kasa", "linear circle fit; biased on short arcs", _planar_methods.circle("kasa")),
    _planar(
        "pratt", "algebraic circle fit; the center is hyper's", _planar_methods.circle("pratt")
    ),
    _planar("taubin", "algebraic circle fit, nearly unbiased", _planar_methods.circle("taubin")),
    _planar(
        "hyper", "algebraic circle fit without essential bias", _planar_methods.circle("hyper")
    ),
    _planar("geometric", "circles of all markers at once, robust", _planar_methods.geometric),
    _planar("running_circle", "hyper, one frame at a time", _planar_methods.running),
    _planar(
        "oriented", "circle and the child's measured angle", _planar_methods.oriented, "angles"
    ),
    _planar("grid", "search on a grid: the published baseline", _planar_methods.grid),
    _planar("three_frames", "closed form through three frames", _planar_methods.three_frames),
    EstimationMethod(
        "gamage_lasenby",
        "linear sphere fit; biased on short arcs",
        ("points",),
        False,
        lambda m: gamage_lasenby(_points(m), m.least_turn),
    ),
    EstimationMethod(
        "halvorsen",
        "linear sphere fit, bias taken out",
        ("points",),
        False,
        lambda m: halvorsen(_points(m), m.least_turn),
    ),
    EstimationMethod(
        "sphere",
        "geometric sphere fit of all markers, robust; distinguishes a hinge from a ball joint",
        ("points",),
        False,
        lambda m: fit_sphere(
            _points(m),
            SphereOptions(start=m.near),
            SphereLimits(min_direction=m.least_turn),
            m.parent_markers,
        ),
    ),
    EstimationMethod(
        "running_sphere",
        "spheres of all markers one frame at a time; distinguishes a hinge from a ball joint",
        ("points",),
        True,
        _stream,
    ),
    EstimationMethod(
        "score",
        "both bodies treated alike; needs three markers on each",
        ("parent", "child"),
        False,
        lambda m: fit_score(*_bodies(m), near=m.near),
    ),
    EstimationMethod(
        "sara",
        "axis of a hinge from both bodies",
        ("parent", "child"),
        False,
        lambda m: fit_axis(*_bodies(m), near=m.near, toward=m.axis),
    ),
)
METHODS: dict[str, EstimationMethod] = {method.name: method for method in _ALL}
"""``kasa pratt taubin hyper geometric running_circle oriented grid three_frames`` (plane),
``gamage_lasenby halvorsen sphere running_sphere score sara`` (space), by name."""
