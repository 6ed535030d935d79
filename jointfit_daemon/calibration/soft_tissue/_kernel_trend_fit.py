"""Fit of the linear trend that replaces the kernel correction outside the training range.

The regressors are the disagreement of each further sensor with the first sensor and, in one of two
fits, the tilt of the segment. The trend is the mean of both fits. The mean has a smaller error than
the fit that is better on held-out movements, because two or three movements are too few for a
selection.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.soft_tissue._robust_ridge import fit_ridge
from jointfit_daemon.limb_model import LEVEL_AXES, TILTS, trend

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

    Row = tuple[float, ...]


PENALTY = 1e-2
"""Ridge penalty of the trend."""

SMALLEST_SCALE = 0.02
"""Constant that is added to the RMS of each regressor, rad, so that a nearly constant regressor is
not amplified.
"""


def fit_trend(u: Array, rho: Array, weights: Array) -> tuple[Row, Row]:
    """Return the coefficients of ``[1, u]`` for the axes x and y, rad per unit.

    Parameters
    ----------
    u : ndarray, shape (n, 3 m + 3)
        Regressors for m sensors, rad: joint rotation (3 columns), disagreement of each of the m - 1
        further sensors with the first sensor (3 columns each), and tilt (3 columns).
    rho : ndarray, shape (n, 3)
        Target corrections, rad.
    weights : ndarray, shape (n,)
        Weights of the frames.
    """
    x, y = (_axis(u, rho[:, axis], axis, weights) for axis in LEVEL_AXES)
    return x, y


def unseen_trend(
    u: Array, rho: Array, groups: Sequence[NDArray[np.bool_]], weights: Array
) -> Array:
    """Return the trend of every frame from a fit without the group of the frame, rad, (n, 3)."""
    found = np.empty_like(rho)
    for held in groups:
        found[held] = trend(fit_trend(u[~held], rho[~held], weights[~held]), u[held])
    return found


def _axis(u: Array, y: Array, axis: int, weights: Array) -> Row:
    """Return the coefficients of one axis, which are the mean of both fits."""
    width = u.shape[1]
    # Component `axis` of the disagreement of each further sensor. The first three columns are the
    # joint rotation, which is no regressor of the trend.
    pairs = list(range(3 + axis, width - TILTS, 3))
    # A rotation about x moves the vertical along y of the segment, and vice versa.
    tilt = width - TILTS + (1 - axis)

    row = np.zeros(1 + width)
    for columns in (pairs, [*pairs, tilt]):
        phi = np.concatenate([np.ones((len(u), 1)), u[:, columns]], axis=1)
        ridge = fit_ridge(phi, y[:, None], PENALTY, SMALLEST_SCALE, weights=weights)
        row[[0, *(1 + column for column in columns)]] += 0.5 * ridge.coefficients[:, 0]
    return tuple(row.tolist())
