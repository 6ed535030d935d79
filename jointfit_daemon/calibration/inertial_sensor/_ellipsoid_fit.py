r"""Fit of an ellipsoid to measurements of a vector of constant magnitude.

Let b be the bias of a sensor, and M the matrix of inverse scale factors and non-orthogonality. A
measurement v of a vector with the magnitude r satisfies

.. math:: |M (v - b)| = r

M can be chosen symmetric, because a rotation of all three axes does not change magnitudes. The
parameters minimize the sum of the squared differences between the magnitudes and r.

Sources: Frosio, Pedersini and Borghese 2009, IEEE Trans. Instrum. Meas. 58, 2034-2041, equations
5 to 9 (accelerometers); Gebre-Egziabher et al. 2006, J. Aerospace Eng. 19, 87-102 (magnetometers).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import least_squares

from jointfit_daemon.calibration.inertial_sensor._refusal import SensorCalibrationError

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

DIAGONAL, SYMMETRIC = 6, 9
"""Numbers of parameters: six for bias and scale factors, nine with the non-orthogonality."""
_OFF_DIAGONAL = ((0, 1), (0, 2), (1, 2))
_BIAS, _SCALE, _SKEW = slice(0, 3), slice(3, 6), slice(6, 9)


@dataclass(frozen=True, slots=True)
class EllipsoidFit:
    """Parameters of an ellipsoid, in the unit of the fitted vectors."""

    bias: Array
    """Center of the ellipsoid, shape (3,)."""
    matrix: Array
    """Symmetric matrix that maps the ellipsoid to the unit sphere, shape (3, 3)."""
    covariance: Array
    """Covariance of the p parameters: the center, and the diagonal and (if fitted) upper
    off-diagonal elements of `matrix`, shape (p, p).
    """
    residuals: Array
    """Magnitudes minus 1, shape (n,)."""
    degrees_of_freedom: int
    """Number of measurements minus number of parameters."""


def fit_unit_ellipsoid(vectors: Array, parameters: int) -> EllipsoidFit:
    """Fit an ellipsoid to vectors whose mean is near 0 and whose lengths are approximately 1.

    Parameters
    ----------
    vectors
        Normalized measurements, shape (n, 3), n > `parameters`.
    parameters
        `DIAGONAL` or `SYMMETRIC`.

    Raises
    ------
    SensorCalibrationError
        The measurements do not determine an ellipsoid.
    """
    start = np.zeros(parameters)
    start[_SCALE] = 1.0

    def residuals(values: Array) -> Array:
        mapped = (vectors - values[_BIAS]) @ _matrix(values)
        return np.asarray(np.linalg.norm(mapped, axis=1) - 1.0)

    def jacobian(values: Array) -> Array:
        about = vectors - values[_BIAS]
        matrix = _matrix(values)
        mapped = about @ matrix
        mapped /= np.linalg.norm(mapped, axis=1)[:, None]
        skews = [
            mapped[:, row] * about[:, column] + mapped[:, column] * about[:, row]
            for row, column in _OFF_DIAGONAL[: parameters - DIAGONAL]
        ]
        return np.column_stack((-mapped @ matrix, mapped * about, *skews))

    found = least_squares(
        residuals, start, jacobian, method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-12
    )
    matrix, slopes = _matrix(found.x), jacobian(found.x)
    normal = slopes.T @ slopes
    if not found.success or np.linalg.eigvalsh(matrix)[0] <= 0.0 or np.linalg.cond(normal) > _WORST:
        raise SensorCalibrationError(
            "the measurements determine no ellipsoid: expected directions on all sides of the "
            "sensor. Repeat the step, and turn the sensor to all sides"
        )

    freedom = len(vectors) - parameters
    variance = float(found.fun @ found.fun) / freedom
    return EllipsoidFit(
        found.x[_BIAS], matrix, np.asarray(variance * np.linalg.inv(normal)), found.fun, freedom
    )


_WORST = 1e10
"""Largest condition number of the normal equations."""


def _matrix(values: Array) -> Array:
    """Return the symmetric matrix of a set of parameters."""
    matrix = np.diag(values[_SCALE])
    for (row, column), value in zip(_OFF_DIAGONAL, values[_SKEW], strict=False):
        matrix[row, column] = matrix[column, row] = value
    return matrix


def matrix_sd(deviations: Array) -> Array:
    """Return standard deviations of matrix elements in the form of the matrix, shape (3, 3).

    Elements that are not estimated are NaN.

    Parameters
    ----------
    deviations
        Standard deviations of the diagonal and, if estimated, of the upper off-diagonal elements,
        shape (3,) or (6,).
    """
    out = np.full((3, 3), np.nan)
    np.fill_diagonal(out, deviations[:3])
    for (row, column), value in zip(_OFF_DIAGONAL, deviations[3:], strict=False):
        out[row, column] = out[column, row] = value
    return out
