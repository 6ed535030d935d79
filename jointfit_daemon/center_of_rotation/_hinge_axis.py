"""Uncertainty of a hinge axis, used by all estimators that return an axis."""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation._path_statistics import (
    lag_one_correlation,
    variance_inflation,
)
from jointfit_daemon.center_of_rotation.planar import plane_of

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

_FEWEST = 4
"""Smallest number of marker positions from which two slopes and a variance can be estimated."""


def hinge_axis_sd(points: Array, axis: Array | None) -> float | None:
    r"""Return the standard deviation of a hinge's axis from the paths of markers, rad.

    The axis is the common normal of the marker paths. The error of the axis equals the error of the
    two slopes β in a regression of e on x. e is the position of a marker along the axis, and x its
    position perpendicular to the axis, both relative to the mean of the marker,

    .. math:: e_{tj} = x_{tj}^T \beta, \qquad
              \mathrm{Cov}(\beta) = s_e^2 \Big( \sum_{tj} x_{tj} x_{tj}^T \Big)^{-1}
              \frac{1+\rho}{1-\rho}

    for frame t and marker j, where :math:`s_e^2` is the residual variance and ρ the correlation of
    e between successive frames. Soft-tissue artefact and rotations about another axis increase
    :math:`s_e`.

    Parameters
    ----------
    points : ndarray, shape (n, k, 3)
        Markers of the child in the parent's coordinates, m; NaN if not visible.
    axis : ndarray, shape (3,), or None
        Unit vector along the axis.

    Returns
    -------
    float or None
        Square root of the mean variance in the two directions perpendicular to the axis; None if
        `axis` is None, or if the data do not determine the error of the axis.
    """
    seen = np.asarray(np.isfinite(points).all(axis=-1))
    if axis is None or np.count_nonzero(seen) < _FEWEST:
        return None
    with np.errstate(invalid="ignore"):
        mean = np.where(seen[..., None], points, 0.0).sum(axis=0)
        away = points - mean / np.maximum(seen.sum(axis=0), 1)[:, None]
    across, along = away @ plane_of(axis), np.where(seen, away @ axis, 0.0)

    x, e = across[seen], along[seen]
    free = max(len(e) - points.shape[1] - 2, 1)
    information = x.T @ x
    if np.linalg.eigvalsh(information)[0] <= 0.0:
        return None
    inflation = variance_inflation(lag_one_correlation(along, seen))
    covariance = float(e @ e) / free * inflation * np.linalg.inv(information)
    return sqrt(float(np.trace(covariance)) / 2.0)
