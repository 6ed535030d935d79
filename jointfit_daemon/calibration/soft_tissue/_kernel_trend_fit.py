"""Fit of the linear trend that replaces the kernel correction outside the training range.

The trend is the mean of two fits, one without and one with tilt. If the training contains few
movements, joint rotation and tilt are correlated, and neither fit alone generalizes.
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


def fit_trend(u: Array, rho: Array) -> tuple[Row, Row]:
    """Return the coefficients of ``[1, u]`` for the axes x and y, rad per unit.

    Parameters
    ----------
    u : ndarray, shape (n, 3 m + 3)
        Relative rotations of m sensors, then tilts.
    rho : ndarray, shape (n, 3)
        Target corrections, rad.
    """
    x, y = (_axis(u, rho[:, axis], axis) for axis in LEVEL_AXES)
    return x, y


def unseen_trend(u: Array, rho: Array, groups: Sequence[NDArray[np.bool_]]) -> Array:
    """Return the trend of every frame from a fit without its group, rad, shape (n, 3)."""
    found = np.empty_like(rho)
    for held in groups:
        found[held] = trend(fit_trend(u[~held], rho[~held]), u[held])
    return found


def _axis(u: Array, y: Array, axis: int) -> Row:
    """Return the coefficients of one axis, which are the mean of both fits."""
    width = u.shape[1]
    # Columns of the same axis for each further sensor, after the three columns of the joint
    # rotation.
    pairs = list(range(3 + axis, width - TILTS, 3))
    # A rotation about x moves the vertical along y of the segment, and vice versa.
    tilt = width - TILTS + (1 - axis)

    row = np.zeros(1 + width)
    for columns in (pairs, [*pairs, tilt]):
        phi = np.concatenate([np.ones((len(u), 1)), u[:, columns]], axis=1)
        found = fit_ridge(phi, y[:, None], PENALTY, SMALLEST_SCALE).coefficients[:, 0]
        row[[0, *(1 + column for column in columns)]] += 0.5 * found
    return tuple(row.tolist())
