"""Table of all estimators, and the function `estimate_center` that runs an estimator by name.

`METHODS` lists the inputs that each method needs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import degrees, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation import _planar_methods
from jointfit_daemon.center_of_rotation._movement import Movement
from jointfit_daemon.center_of_rotation._planar_methods import each
from jointfit_daemon.center_of_rotation._result import name_flagged_markers, refusal
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
    from jointfit_daemon.center_of_rotation._result import CenterEstimate
    from jointfit_daemon.center_of_rotation.planar import CircleMethod


_ASK_EVERY = 50
"""Number of frames between two estimates of ``running_sphere``. Each estimate updates the outlier
weights.
"""


@dataclass(frozen=True, slots=True)
class EstimationMethod:
    """Entry of the estimator table `METHODS`."""

    name: str
    about: str
    """One-line description."""
    needs: tuple[str, ...]
    """Fields of `Movement` that must be given: ``points``, ``parent`` and ``child``, ``angles``."""
    planar: bool
    """Whether the method accepts points in a plane. Circle methods project points in space along
    `Movement.axis`.
    """
    run: Callable[..., CenterEstimate]
    """Function that returns the estimate. Its arguments are the movement and the fields in
    `needs`."""


def estimate_center(movement: Movement | Array, method: str = "auto") -> CenterEstimate:
    """Estimate a center of rotation by any method.

    Parameters
    ----------
    movement : Movement or ndarray
        Input data. An array, shape (n, k, d) or (n, d), is equivalent to a `Movement` with only
        these points.
    method : str
        A key of `METHODS`, or ``auto``. ``auto`` selects ``score`` if `points` is None. Otherwise
        it selects ``geometric`` for points in a plane. For points in space it selects ``score`` if
        the poses and the markers (`Movement.both_markers`) of both bodies are known, and ``sphere``
        if not.

    Returns
    -------
    CenterEstimate
        Estimate. If the movement does not determine a center, `refused` contains the cause and the
        remedy.

    Raises
    ------
    ValueError
        The method is unknown, the movement lacks a required field, or its points have the wrong
        shape. Unusable data do not raise an error; the estimate is then refused.
    """
    if not isinstance(movement, Movement):
        movement = Movement(np.asarray(movement, dtype=np.float64))
    if movement.points is not None:
        p = np.asarray(movement.points, dtype=np.float64)
        p = p[:, None] if p.ndim == 2 else p
        if p.ndim != 3 or p.shape[1] == 0 or p.shape[2] not in {2, 3}:
            raise ValueError(f"points have shape {p.shape}, expected (n, k, 2) or (n, k, 3)")
        whole = np.isfinite(p).all(axis=-1, keepdims=True)
        movement = replace(movement, points=np.where(whole, p, np.nan))

    if method == "auto":
        method = _automatic(movement)
    chosen = METHODS.get(method)
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

    given = [getattr(movement, name) for name in chosen.needs]
    found = _beyond_parent(chosen.run(movement, *given), movement.parent_markers)
    return found if movement.names is None else name_flagged_markers(found, movement.names)


def _automatic(movement: Movement) -> str:
    if movement.points is None:
        return "score"
    if movement.points.shape[-1] == 2:
        return "geometric"
    posed = movement.parent is not None and movement.child is not None
    return "score" if posed and movement.both_markers() is not None else "sphere"


def _beyond_parent(found: CenterEstimate, parent: Array | None) -> CenterEstimate:
    """Refuse an estimate if noise of the parent's markers alone may explain its rotation."""
    if parent is None or found.refused is not None or len(found.center) < 3:
        return found
    turn = sqrt(NOISE_FACTOR) * turn_noise(parent, found.noise)
    # for directions spread evenly over an arc, the mean angle to the middle is arc / 4
    if found.arc / 4.0 > turn:
        return found
    why = (
        f"the joint turned {degrees(found.arc):.0f}°, which may be only noise of the parent's "
        "markers: move the joint further, or put the parent's markers further apart"
    )
    return replace(found, refused=why)


def _stream(movement: Movement, points: Array) -> CenterEstimate:
    limits = SphereLimits(min_direction=movement.least_turn)
    k, d = points.shape[1:]
    stream = RunningSphere(k, dimension=d, near=movement.near, limits=limits)
    for number, frame in enumerate(points, 1):
        stream.feed(frame)
        if number % _ASK_EVERY == 0:
            stream.estimate()
    return stream.estimate()


def _planar(name: str, about: str, fit: _planar_methods.MarkerFit, *more: str) -> EstimationMethod:
    def run(movement: Movement, points: Array, *_: Array) -> CenterEstimate:
        return _planar_methods.fit_in_plane(name, fit, movement, points)

    return EstimationMethod(name, about, ("points", *more), True, run)


def _circle(name: CircleMethod, about: str) -> EstimationMethod:
    return _planar(name, about, each(_planar_methods.circle(name)))


_ALL = (
    _circle("kasa", "linear circle fit; biased on short arcs"),
    _circle("pratt", "algebraic circle fit with the same center as hyper"),
    _circle("taubin", "algebraic circle fit, nearly unbiased"),
    _circle("hyper", "algebraic circle fit without essential bias"),
    _planar("geometric", "circles of all markers at once, robust", _planar_methods.geometric),
    _planar("running_circle", "hyper, updated frame by frame", each(_planar_methods.running)),
    _planar(
        "oriented",
        "circle fit that also uses the measured angle of the child",
        each(_planar_methods.fit_oriented),
        "angles",
    ),
    _planar("grid", "search on a grid: the published baseline", each(_planar_methods.grid)),
    _planar("three_frames", "closed form through three frames", each(_planar_methods.three_frames)),
    EstimationMethod(
        "gamage_lasenby",
        "linear sphere fit; biased on short arcs",
        ("points",),
        False,
        lambda m, points: gamage_lasenby(points, m.least_turn),
    ),
    EstimationMethod(
        "halvorsen",
        "linear sphere fit, corrected for its bias",
        ("points",),
        False,
        lambda m, points: halvorsen(points, m.least_turn),
    ),
    EstimationMethod(
        "sphere",
        "geometric sphere fit of all markers, robust; distinguishes a hinge from a ball joint",
        ("points",),
        False,
        lambda m, points: fit_sphere(
            points,
            SphereOptions(start=m.near),
            SphereLimits(min_direction=m.least_turn),
            m.parent_markers,
        ),
    ),
    EstimationMethod(
        "running_sphere",
        "sphere fit of all markers, updated frame by frame; distinguishes hinge and ball joint",
        ("points",),
        True,
        _stream,
    ),
    EstimationMethod(
        "score",
        "point that is fixed in both bodies; needs three markers on each body",
        ("parent", "child"),
        False,
        lambda m, parent, child: fit_score(parent, child, near=m.near, markers=m.both_markers()),
    ),
    EstimationMethod(
        "sara",
        "axis of a hinge that is fixed in both bodies",
        ("parent", "child"),
        False,
        lambda m, parent, child: fit_axis(
            parent, child, near=m.near, toward=m.axis, markers=m.both_markers()
        ),
    ),
)
METHODS: dict[str, EstimationMethod] = {method.name: method for method in _ALL}
"""Estimators by name. The circle methods are ``kasa pratt taubin hyper geometric running_circle
oriented grid three_frames``. The methods in space are ``gamage_lasenby halvorsen sphere
running_sphere score sara``, of which ``running_sphere`` also accepts points in a plane.
"""
