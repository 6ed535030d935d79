r"""Comparison of the three-frame solution with geometric methods, for the same range of motion.

Two markers of a rigid body rotate by 2α. Both are at the same distance from the center, and the
angle between them is `APART_RAD`. Methods that need two frames use the first and the last frame.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation.planar import fit_circles, three_frame_center

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation.study._circle_study import StudySetup

APART_RAD = np.pi / 3.0
"""Angle between the two markers about the center, rad."""
_LEAST_TURN = 1e-12
"""Angle below which a rotation counts as a rounding error, rad."""


def bisector_center(points: ArrayLike) -> Array:
    r"""Return the point nearest to the perpendicular bisectors of all chords.

    .. math:: \min_c \sum_{k,a<b} \left[ (p_{kb} - p_{ka})^T c
              - \tfrac12 (|p_{kb}|^2 - |p_{ka}|^2) \right]^2

    The sum is over markers k and pairs of frames a, b, and p are the marker positions. For two
    markers in two frames the result is Reuleaux's construction. For one marker in three frames it
    is `three_frame_center`.

    Parameters
    ----------
    points : array_like, shape (..., k, n, 2)
        Positions of k markers in n frames, m.

    Returns
    -------
    ndarray, shape (..., 2)
        Centers, m; not finite if all bisectors are parallel.
    """
    p = np.asarray(points, dtype=np.float64)
    middle = p.mean(axis=(-3, -2), keepdims=True)
    p = p - middle
    first, second = np.array(list(combinations(range(p.shape[-2]), 2))).T
    chord = p[..., second, :] - p[..., first, :]
    half = ((p[..., second, :] ** 2).sum(axis=-1) - (p[..., first, :] ** 2).sum(axis=-1)) / 2.0

    A = np.einsum("...kca,...kcb->...ab", chord, chord)
    b = np.einsum("...kca,...kc->...a", chord, half)
    det = A[..., 0, 0] * A[..., 1, 1] - A[..., 0, 1] ** 2
    x = A[..., 1, 1] * b[..., 0] - A[..., 0, 1] * b[..., 1]
    y = A[..., 0, 0] * b[..., 1] - A[..., 0, 1] * b[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.stack((x, y), axis=-1) / det[..., None] + middle[..., 0, 0, :])


def rotation_pole(first: ArrayLike, second: ArrayLike) -> Array:
    r"""Return the pole of a planar displacement, the point that the displacement does not move.

    .. math:: c = (\bar b - R \bar a) (I - R)^{-1}

    in complex numbers, where R is the rotation of the least-squares rigid fit of the marker sets a
    and b, and :math:`\bar a`, :math:`\bar b` are their means.

    Parameters
    ----------
    first, second : array_like, shape (..., k, 2)
        Positions of at least two markers in two frames, m.

    Returns
    -------
    ndarray, shape (..., 2)
        Poles, m; not finite without rotation.
    """
    a, b = (np.asarray(p, dtype=np.float64) @ np.array([1.0, 1.0j]) for p in (first, second))
    mean_a, mean_b = a.mean(axis=-1), b.mean(axis=-1)
    moment = ((b - mean_b[..., None]) * (a - mean_a[..., None]).conj()).sum(axis=-1)
    turn = np.exp(1j * np.angle(moment))
    still = np.abs(1.0 - turn) < _LEAST_TURN
    pole = (mean_b - turn * mean_a) / np.where(still, 1.0, 1.0 - turn)
    return np.where(still[..., None], np.inf, np.stack((pole.real, pole.imag), axis=-1))


def compare_methods(setup: StudySetup) -> Mapping[str, Array]:
    """Return the median error of each method over α, m, shape (len(setup.steps),).

    The result is a median because some errors have no finite mean square. The setup contains
    radius, noise, number of runs and seed.
    """
    rng = np.random.default_rng(setup.seed)
    found: dict[str, list[float]] = {}
    for step in setup.steps:
        shares = np.linspace(0.0, 1.0, setup.frames)
        three = _body(setup, rng, step * np.arange(3.0), setup.repeats)
        many = _body(setup, rng, 2.0 * step * shares, setup.frames_repeats)
        ends = three[:, :, [0, -1]]
        centers = {
            "three frames": three_frame_center(three[:, 0]),
            "bisectors": bisector_center(three),
            "Reuleaux": bisector_center(ends),
            "helical axis": rotation_pole(ends[:, :, 0], ends[:, :, 1]),
            "hyper": fit_circles(many[:, 0]).center,
        }
        for name, center in centers.items():
            error = np.linalg.norm(center, axis=-1)
            found.setdefault(name, []).append(float(np.median(error)))
    return {name: np.array(errors) for name, errors in found.items()}


def _body(setup: StudySetup, rng: np.random.Generator, angles: Array, repeats: int) -> Array:
    """Return measured positions of both markers about the origin, shape (repeats, 2, frames, 2)."""
    turned = angles + np.array([[0.0], [APART_RAD]])
    true = setup.radius * np.stack((np.cos(turned), np.sin(turned)), axis=-1)
    return np.asarray(true + rng.normal(0.0, setup.noise, (repeats, *true.shape)))
