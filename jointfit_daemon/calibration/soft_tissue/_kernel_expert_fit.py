"""Fit of one kernel expert: width and penalties from held-out groups."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.calibration.soft_tissue._kernel_ridge import Basis, choose, fit
from jointfit_daemon.calibration.soft_tissue._leverage_variance_fit import (
    SMALLEST_LEVERAGE,
    hull,
    ratios,
)
from jointfit_daemon.limb_model import Expert, as_rows, bumps, smooth_terms, widths_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array
if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

    Ways = Sequence[Sequence[NDArray[np.bool_]]]


HULL_QUANTILE = 0.995


class Fitted(NamedTuple):
    """An expert, and what it had said of frames it had not seen."""

    expert: Expert
    unseen: tuple[Array, ...]
    """By way of leaving out: its corrections of held-out frames, rad, shape (n, 3)."""
    ratios: tuple[Array, ...]
    """By way: how far each frame lay outside the others, shape (n,)."""


def fit_expert(u: Array, rho: Array, sensors: int, ways: Ways, *, tilted: bool) -> Fitted:
    """Fit one expert; the width is the one of the smallest squared error on held-out groups.

    Penalties are stacked once for every way of leaving out, and the fits by these shares averaged:
    whole trials ask what carries over to another movement, blocks what does within one.

    Parameters
    ----------
    u : ndarray, shape (n, 3 m + 3)
        Relative rotations, then tilts.
    rho : ndarray, shape (n, 3)
        What is to be corrected, rad.
    ways : sequence of sequence of ndarray of bool, shape (n,)
        Ways of leaving out, each with its groups.
    """
    seen = u if tilted else u[:, : 3 * sensors]
    smooth = smooth_terms(seen)
    best = None
    for width in WIDTHS:
        x = seen / widths_of(width, sensors, tilted=tilted)
        centers = spread_centers(x)
        basis = Basis.of(smooth, bumps(x, centers), bumps(centers, centers))
        held = [choose(basis, rho, groups) for groups in ways]
        score = sum(float(np.sum(each.residuals**2)) for each in held)
        if best is None or score < best[0]:
            best = (score, width, centers, basis, held)
    if best is None:
        raise ValueError("no width to choose")
    _, width, centers, basis, held = best
    C = np.mean([fit(basis, rho, each.shares) for each in held], axis=0)
    leverage = hull(smooth)
    h = np.einsum("ij,jk,ik->i", smooth, leverage, smooth)
    expert = Expert(
        width=width,
        tilted=tilted,
        coefficients=as_rows(C.T.tolist()),
        centers=as_rows(centers.tolist()),
        leverage=as_rows(leverage.tolist()),
        hull_leverage=max(float(np.quantile(h, HULL_QUANTILE)), SMALLEST_LEVERAGE),
        carried=tuple(held[-1].shares.sum(axis=(1, 2)).tolist()),
    )
    unseen = tuple(rho - each.residuals for each in held)
    return Fitted(expert, unseen, tuple(ratios(smooth, groups) for groups in ways))


WIDTHS = (0.35, 0.5, 0.8)
"""Joint rotations and tilts this far apart have much to do with each other, rad: what a fit may
choose among."""

MOST_CENTERS = 24

NEAREST_CENTERS = 0.01
"""Centers nearer to each other than this (square root of it, in widths) say the same."""


def spread_centers(x: Array) -> Array:
    """Return frames that lie far from each other and from zero, shape (m, width).

    Farthest-point choice, at most 24: each is the frame farthest from all before it.

    Parameters
    ----------
    x : ndarray, shape (n, width)
        Relative rotations, and tilts, in widths.
    """
    distance = np.sum(x**2, axis=1)
    chosen: list[int] = []
    while len(chosen) < MOST_CENTERS:
        far = int(np.argmax(distance))
        if distance[far] < NEAREST_CENTERS:
            break
        chosen.append(far)
        distance = np.minimum(distance, np.sum((x - x[far]) ** 2, axis=1))
    return x[chosen]
