"""Fit of one kernel expert, whose width and penalties are determined by held-out groups."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.calibration.soft_tissue._kernel_ridge import Basis, choose, fit
from jointfit_daemon.calibration.soft_tissue._leverage_variance_fit import (
    SMALLEST_LEVERAGE,
    hull,
    ratios,
)
from jointfit_daemon.limb_model import KernelExpert, as_rows, bumps, smooth_terms, widths_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

    Ways = Sequence[Sequence[NDArray[np.bool_]]]


HULL_QUANTILE = 0.995
"""Quantile of the training leverage that defines the training range."""
WIDTHS = (0.35, 0.5, 0.8)
"""Candidate kernel widths, rad. The width is the distance in joint rotation and tilt over which the
corrections are correlated.
"""
MOST_CENTERS = 24
"""Largest number of kernel centers (bumps)."""
NEAREST_CENTERS = 0.01
"""Squared distance between two centers, in squared kernel widths, below which one is redundant."""


class Fitted(NamedTuple):
    """A fitted expert with its predictions of held-out frames."""

    expert: KernelExpert
    unseen: tuple[Array, ...]
    """Predicted corrections of held-out frames, for each grouping, rad, shape (n, 3)."""
    ratios: tuple[Array, ...]
    """Leverage ratio of each held-out frame for each grouping, shape (n,)."""


def fit_expert(
    u: Array, rho: Array, sensors: int, ways: Ways, weights: Array, *, tilted: bool
) -> Fitted:
    """Fit one expert with the width that has the smallest squared error on held-out groups.

    Fits with different penalties are combined by stacking, once for each grouping. The results are
    averaged. Whole trials as groups measure the generalization to another movement; blocks in time
    measure the generalization within a movement.

    Parameters
    ----------
    u : ndarray, shape (n, 3 sensors + 3)
        Regressors as returned by `model_inputs`, rad.
    rho : ndarray, shape (n, 3)
        Target corrections, rad.
    sensors : int
        Number of relative rotations in `u`.
    tilted : bool
        Whether the expert also uses the tilts, the last three columns of `u`.
    ways : sequence of sequence of ndarray of bool, shape (n,)
        Groupings of the frames. Each grouping is a sequence of masks, one for each held-out group.
    weights : ndarray, shape (n,)
        Weights of the frames, with mean 1.
    """
    seen = u if tilted else u[:, : 3 * sensors]
    smooth = smooth_terms(seen)

    # Select the width with the smallest held-out error.
    best = None
    for width in WIDTHS:
        x = seen / widths_of(width, sensors, tilted=tilted)
        centers = spread_centers(x)
        basis = Basis.of(smooth, bumps(x, centers), bumps(centers, centers))
        held = [choose(basis, rho, groups, weights) for groups in ways]
        score = sum(float(weights @ np.sum(each.residuals**2, axis=1)) for each in held)
        if best is None or score < best[0]:
            best = (score, width, centers, basis, held)
    if best is None:
        raise ValueError("no width to choose")
    _, width, centers, basis, held = best

    # Fit to all frames. The weights (shares) of the penalties result from stacking each grouping.
    C = np.mean([fit(basis, rho, each.shares, weights) for each in held], axis=0)
    leverage = hull(smooth, weights)
    h = np.einsum("ij,jk,ik->i", smooth, leverage, smooth)
    expert = KernelExpert(
        width=width,
        tilted=tilted,
        coefficients=as_rows(C.T.tolist()),
        centers=as_rows(centers.tolist()),
        leverage=as_rows(leverage.tolist()),
        hull_leverage=max(float(np.quantile(h, HULL_QUANTILE)), SMALLEST_LEVERAGE),
        carried=tuple(held[-1].shares.sum(axis=(1, 2)).tolist()),
    )

    unseen = tuple(rho - each.residuals for each in held)
    return Fitted(expert, unseen, tuple(ratios(smooth, groups, weights) for groups in ways))


def spread_centers(x: Array) -> Array:
    """Select m of n frames, far from each other and from zero, shape (m, k).

    At most 24 frames are selected. Each step selects the frame that is farthest from its nearest
    neighbour among zero and the selected frames (farthest-point selection).

    Parameters
    ----------
    x : ndarray, shape (n, k)
        Relative rotations and tilts, in kernel widths.
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
