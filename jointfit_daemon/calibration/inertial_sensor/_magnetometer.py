r"""Hard-iron and soft-iron parameters of a magnetometer from free rotation.

In a homogeneous field the corrected readings have the same magnitude in every orientation:

.. math:: |M (m_i - b)| = r, \qquad \det M = 1

b is the hard-iron offset, M contains soft iron, scale factors and non-orthogonality, and r is the
magnitude of the field in the unit of the device.

Source: Gebre-Egziabher, Elkaim, Powell and Parkinson 2006, J. Aerospace Eng. 19, 87-102; the
symmetric form of M as in Kok and Schön 2016, IEEE Sensors J. 16, 5679-5689, section III.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import dist, inf
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.inertial_sensor._directions import (
    DIRECTIONS,
    FACES,
    direction_names,
    nearest_direction,
)
from jointfit_daemon.calibration.inertial_sensor._ellipsoid_fit import (
    SYMMETRIC,
    fit_unit_ellipsoid,
    matrix_sd,
)
from jointfit_daemon.calibration.inertial_sensor._refusal import SensorCalibrationError
from jointfit_daemon.calibration.inertial_sensor._step_progress import StepProgress
from jointfit_daemon.name_lists import list_names

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.inertial_sensor._rest_blocks import SensorReading
    from jointfit_daemon.model import Vector

COMPLETE = 25
"""Number of field directions, of 26, in a complete step."""
FEWEST_DIRECTIONS = 21
"""Fewest field directions of a fit."""
FEWEST_READINGS = 100
"""Fewest readings of a fit."""
MOST_READINGS = 4000
"""Largest number of stored readings."""
LARGEST_RESIDUAL = 0.05
"""Largest RMS of the corrected magnitudes about r, relative to r."""
LARGEST_SD = 0.02
"""Largest standard deviation of a parameter, relative to r."""
NOISE_SHARE = 0.3
"""Standard deviation of the distances from the center, relative to their mean, above which readings
are considered noise about a point. Soft iron causes smaller values.
"""
FEWEST_ON_SPHERE = 20
"""Smallest number of readings from which the center is estimated."""
_EVERY = 20
"""Number of stored readings between two computations of the missing directions."""
_MOST_NAMES = 6
"""Largest number of directions in an error message."""
_SPACING = 0.05
"""Smallest distance of a stored reading from the reading stored before, as a fraction of half the
range of all readings (mean over the three axes). Readings at rest contain no additional
information.
"""
_SATURATED_SHARE = 0.03
"""Fraction of the readings with exactly the largest or smallest value, above which the readings
count as saturated.
"""


@dataclass(frozen=True, slots=True)
class MagnetometerEstimate:
    """Parameters of a magnetometer.

    If m is a measured field, `matrix` (m - `bias`) is the corrected field.
    """

    bias: Array
    """Hard-iron offset in the unit of the device, shape (3,)."""
    matrix: Array
    """Matrix of soft iron, scale factors and non-orthogonality, shape (3, 3). It is symmetric and
    has the determinant 1.
    """
    bias_sd: Array
    """Standard deviations of the offset in the unit of the device, shape (3,)."""
    matrix_sd: Array
    """Standard deviations of the elements of the matrix, shape (3, 3)."""
    covariance: Array
    """Covariance of offset, diagonal and upper off-diagonal elements, shape (9, 9)."""
    magnitude: float
    """Magnitude of the field, r, in the unit of the device."""
    degrees_of_freedom: int
    """Number of readings minus number of parameters."""
    readings: int
    spread_before: float
    """Standard deviation of the uncorrected magnitudes relative to their mean."""
    residual: float
    """RMS of the corrected magnitudes about r, relative to r."""
    missing: tuple[str, ...]
    """Directions of the field that no reading has, in sensor axes."""


def fit_magnetometer(fields: Array) -> MagnetometerEstimate:
    """Estimate the parameters from readings in all orientations.

    Parameters
    ----------
    fields
        Readings in the unit of the device, shape (n, 3).

    Raises
    ------
    SensorCalibrationError
        There are too few readings or directions, readings are saturated, or the field is disturbed.
    """
    if len(fields) < FEWEST_READINGS:
        raise SensorCalibrationError(
            f"{len(fields)} readings of different directions, expected at least {FEWEST_READINGS}: "
            "turn the sensor to all sides for half a minute"
        )
    _check_saturation(fields)
    origin, unit = _fit_sphere(fields)
    _check_coverage(_missing(fields))
    fit = fit_unit_ellipsoid((fields - origin) / unit, SYMMETRIC)

    # The fitted matrix S maps to the unit sphere. Hence r = det(S)^(-1/3), in units of `unit`, and
    # M = r S.
    ratio = float(np.linalg.det(fit.matrix)) ** (-1.0 / 3.0)
    matrix, bias = ratio * fit.matrix, origin + unit * fit.bias
    missing = _directions_without((fields - bias) @ matrix)
    _check_coverage(missing)
    covariance = _scaled_covariance(fit.covariance, fit.matrix, ratio, unit)
    deviations = np.sqrt(np.diag(covariance))
    magnitudes = np.linalg.norm(fields, axis=1)
    estimate = MagnetometerEstimate(
        bias=bias,
        matrix=matrix,
        bias_sd=deviations[:3],
        matrix_sd=matrix_sd(deviations[3:]),
        covariance=covariance,
        magnitude=unit * ratio,
        degrees_of_freedom=fit.degrees_of_freedom,
        readings=len(fields),
        spread_before=float(magnitudes.std() / magnitudes.mean()),
        residual=float(np.sqrt(np.mean(fit.residuals**2))),
        missing=direction_names(missing),
    )
    _check_estimate(estimate)
    return estimate


def _scaled_covariance(covariance: Array, matrix: Array, ratio: float, unit: float) -> Array:
    """Return the covariance of b and M = r S from the covariance of (b - origin) / unit and S."""
    # dr = -r/3 tr(S^-1 dS), dM = r dS + S dr
    inverse = np.linalg.inv(matrix)
    rows, columns = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)
    twice = np.array((1.0, 1.0, 1.0, 2.0, 2.0, 2.0))
    gradient = -ratio / 3.0 * inverse[rows, columns] * twice
    change = np.zeros((9, 9))
    change[:3, :3] = unit * np.eye(3)
    change[3:, 3:] = ratio * np.eye(6) + np.outer(matrix[rows, columns], gradient)
    return change @ covariance @ change.T


def _fit_sphere(fields: Array) -> tuple[Array, float]:
    """Return center, shape (3,), and radius of the sphere through readings, by linear equations.

    The equations are |m|^2 = 2 c m + (r^2 - |c|^2). The center is correct even if the readings
    cover only a part of the sphere. Soft iron is ignored.
    """
    origin = fields.mean(axis=0)
    about = fields - origin
    scale = float(np.sqrt(np.mean(about**2))) or 1.0
    about = about / scale
    solved = np.linalg.lstsq(
        np.column_stack((2.0 * about, np.ones(len(about)))), np.sum(about**2, axis=1), rcond=None
    )[0]
    center = solved[:3]
    radius = float(np.sqrt(max(solved[3] + center @ center, 0.0)))
    return origin + scale * center, scale * radius


def _missing(fields: Array) -> set[int]:
    """Return the indices of directions of the field that no reading has.

    If the readings are noise about one point instead of points on a sphere, all directions are
    returned.
    """
    every = set(range(len(DIRECTIONS)))
    if len(fields) < FEWEST_ON_SPHERE:
        return every
    center, radius = _fit_sphere(fields)
    lengths = np.linalg.norm(fields - center, axis=1)
    if lengths.std() > NOISE_SHARE * lengths.mean() or radius <= 0.0:
        return every
    return _directions_without(fields - center)


def _directions_without(fields: Array) -> set[int]:
    """Return the indices of directions that no vector in `fields` has."""
    return set(range(len(DIRECTIONS))) - set(nearest_direction(fields).tolist())


def _check_coverage(missing: set[int]) -> None:
    covered = len(DIRECTIONS) - len(missing)
    if covered < FEWEST_DIRECTIONS or len([face for face in missing if face < FACES]) > 1:
        shown = list_names(direction_names(missing), _MOST_NAMES)
        raise SensorCalibrationError(
            f"the field was measured in {covered} of {len(DIRECTIONS)} directions, expected at "
            f"least {FEWEST_DIRECTIONS} and five of the six axes; missing in sensor axes: "
            f"{shown}. Turn each of these sides towards the field "
            "(north and down, in the southern hemisphere north and up)"
        )


def _check_saturation(fields: Array) -> None:
    for axis, name in enumerate("xyz"):
        for end in (fields[:, axis].max(), fields[:, axis].min()):
            share = float(np.mean(fields[:, axis] == end))
            if share > _SATURATED_SHARE:
                raise SensorCalibrationError(
                    f"{100 * share:.0f} % of the magnetometer readings along {name} are exactly "
                    f"{end:g}: they are saturated. Remove magnets from the sensor and its mount, "
                    "or set a larger range, and repeat"
                )


def _check_estimate(estimate: MagnetometerEstimate) -> None:
    if estimate.residual > LARGEST_RESIDUAL:
        raise SensorCalibrationError(
            f"after the correction |m| varies by {100 * estimate.residual:.1f} %, expected less "
            f"than {100 * LARGEST_RESIDUAL:.0f} %: the field is disturbed. Repeat at least 1 m "
            "from steel, motors and loudspeakers, and turn the sensor in place"
        )
    sd = float(np.nanmax([*(estimate.bias_sd / estimate.magnitude), *estimate.matrix_sd.ravel()]))
    if sd > LARGEST_SD:
        raise SensorCalibrationError(
            f"the least certain parameter has a standard deviation of {100 * sd:.1f} % of the "
            f"field, expected less than {100 * LARGEST_SD:.0f} %; missing directions: "
            f"{', '.join(estimate.missing) or 'none'}. Repeat, slower and in all directions"
        )


class MagnetometerStep:
    """Collects readings in all orientations, and estimates the parameters."""

    def __init__(self) -> None:
        self._fields: list[Vector] = []
        self._low, self._high = [inf] * 3, [-inf] * 3
        self._received = 0
        self._missing = set(range(len(DIRECTIONS)))

    @property
    def is_complete(self) -> bool:
        """Whether there are enough readings, and they cover enough directions."""
        enough = len(self._fields) >= FEWEST_READINGS
        return enough and len(self._missing) <= len(DIRECTIONS) - COMPLETE

    @property
    def progress(self) -> StepProgress:
        """Fraction of the directions that are covered, and the missing directions."""
        missing = self._missing
        directions = (len(DIRECTIONS) - len(missing)) / COMPLETE
        share = min(directions, len(self._fields) / FEWEST_READINGS, 1.0)
        return StepProgress(share, () if self.is_complete else direction_names(missing))

    def add(self, reading: SensorReading) -> None:
        """Add a reading if its field differs from the field of the last added reading."""
        field = reading.magnetic
        if field is None:
            return
        self._received += 1
        self._low = list(map(min, self._low, field))
        self._high = list(map(max, self._high, field))

        step = _SPACING * (sum(self._high) - sum(self._low)) / 6.0
        fields = self._fields
        if len(fields) >= MOST_READINGS or (fields and dist(field, fields[-1]) <= step):
            return
        fields.append(field)
        if len(fields) % _EVERY == 0:
            self._missing = _missing(np.array(fields))

    def finish(self) -> MagnetometerEstimate:
        """Return the parameters.

        Raises
        ------
        SensorCalibrationError
            There are no readings or too few directions, readings are saturated, or the field is
            disturbed.
        """
        if not self._received:
            raise SensorCalibrationError(
                "no magnetometer readings arrived: switch the magnetometer of the device on"
            )
        return fit_magnetometer(np.array(self._fields))
