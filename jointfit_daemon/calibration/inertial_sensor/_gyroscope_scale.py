r"""Scale factors and axes of a gyroscope from turns between rests.

A turn is a movement between two rests. The accelerometer measures the directions of gravity u_0 and
u_1, in sensor axes, at the rests before and after the turn. The gyroscope measures the rate m, and
the true rate is G (m - b). The rotation R of the turn maps one direction to the other:

.. math:: R u_1 = u_0, \qquad R = \prod_i \exp(G (m_i - b_i) \Delta t_i)

The estimate of G minimizes the sum over all turns of the squared differences between R u_1 and u_0.
b is the mean rate of the rests, interpolated over the turn. A turn determines two of three
components, because a rotation about the vertical does not change u. Turns about a level axis
determine the scale factor of this axis. The error of a scale factor from a full turn is a quarter
of the error from a quarter turn.

Source: Tedaldi, Pretto and Menegatti 2014, ICRA, 3042-3049, section IV.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees, radians
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.inertial_sensor._refusal import SensorCalibrationError
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.inertial_sensor._turns import Turn

FEWEST_TURNS = 6
"""Fewest turns of a fit."""
LARGEST_SCALE_SD = 0.005
"""Largest standard deviation of a scale factor."""
LARGEST_AXES_SD = 0.003
"""Largest standard deviation of any element of the matrix, rad, with which the off-diagonal
elements are used.
"""
LARGEST_RESIDUAL = radians(1.5)
"""Largest RMS of the differences between the directions of gravity, rad."""
LARGEST_SCALE_ERROR = 0.2
"""Largest plausible error of a scale factor."""
_SCALES = (0, 4, 8)
"""Indices of the diagonal elements, counted by rows."""
_ALL = tuple(range(9))
_ITERATIONS = 12
_CONVERGED = 1e-9
_SPARE = 6
"""Fewest degrees of freedom of a fit of all elements."""
_SATURATED = radians(100.0)
"""Rate, rad/s, that every gyroscope measures without saturation."""
_EQUAL_READINGS = 3
"""Number of equal readings at the end of the range that indicates saturation."""


@dataclass(frozen=True, slots=True)
class GyroscopeScaleEstimate:
    """Parameters of a gyroscope.

    `matrix` times the difference of measured rate and bias is the corrected rate. The bias is the
    rate at rest.
    """

    matrix: Array
    """Inverse scale factors, and gyroscope axes relative to the accelerometer axes, shape (3,
    3)."""
    matrix_sd: Array
    """Standard deviations of the elements of `matrix`, shape (3, 3); NaN where an element is not
    estimated.
    """
    covariance: Array
    """Covariance of the diagonal of `matrix`, shape (3, 3), or of all elements by rows, shape
    (9, 9).
    """
    degrees_of_freedom: int
    """Twice the number of turns minus the number of parameters."""
    turns: int
    angle: float
    """Sum of the angles of the turns, rad."""
    spread_before: float
    """RMS of the differences between the directions of gravity without correction, rad."""
    residual: float
    """RMS of the differences between the directions of gravity after correction, rad."""


def fit_gyroscope_scale(
    turns: Sequence[Turn], correct: Callable[[Array], Array]
) -> GyroscopeScaleEstimate:
    """Estimate the scale factors and, if the turns determine the axes, also the axes.

    Parameters
    ----------
    turns
        Turns between rests.
    correct
        Function that corrects a specific force, shape (3,), with the calibration of the
        accelerometer.

    Raises
    ------
    SensorCalibrationError
        There are too few turns, readings are saturated, or the turns do not determine the scale
        factors.
    """
    usable = [turn for turn in turns if not _is_saturated(turn)]
    if len(usable) < FEWEST_TURNS:
        saturated = len(turns) - len(usable)
        found = f"{len(turns)} turns between rests" + f", {saturated} saturated" * bool(saturated)
        raise SensorCalibrationError(
            f"{found}, expected at least {FEWEST_TURNS}: turn the sensor slowly from pose to pose, "
            "and let go of it before and after each turn"
        )

    ends = [
        (_unit(correct(turn.before.force)), _unit(correct(turn.after.force))) for turn in usable
    ]
    fit = _Fit(usable, ends, np.eye(3), _SCALES)
    whole = _Fit(usable, ends, fit.matrix, _ALL) if 2 * len(usable) - len(_ALL) >= _SPARE else None
    if whole is not None and whole.deviations.max() < LARGEST_AXES_SD:
        fit = whole

    matrix_sd = np.full(9, np.nan)
    matrix_sd[list(fit.elements)] = fit.deviations
    moved = (np.linalg.norm(np.diff(turn.t_s)[:, None] * _means(turn), axis=1) for turn in usable)
    estimate = GyroscopeScaleEstimate(
        matrix=fit.matrix,
        matrix_sd=matrix_sd.reshape(3, 3),
        covariance=fit.covariance,
        degrees_of_freedom=fit.degrees_of_freedom,
        turns=len(usable),
        angle=float(sum(each.sum() for each in moved)),
        spread_before=_rms(_differences(usable, ends, np.eye(3))[0]),
        residual=_rms(fit.differences),
    )
    _check(estimate)
    return estimate


class _Fit:
    """Gauss-Newton least squares over some elements of the matrix."""

    def __init__(
        self,
        turns: Sequence[Turn],
        ends: Sequence[tuple[Array, Array]],
        start: Array,
        elements: tuple[int, ...],
    ) -> None:
        self.elements = elements
        self.matrix = start.copy()
        columns = list(elements)
        for _ in range(_ITERATIONS):
            self.differences, slopes = _differences(turns, ends, self.matrix)
            slopes = slopes[:, columns]
            change = np.linalg.lstsq(slopes, self.differences, rcond=None)[0]
            self.matrix.flat[columns] += change
            if np.abs(change).max() < _CONVERGED:
                break
        self.differences, slopes = _differences(turns, ends, self.matrix)
        slopes = slopes[:, columns]

        self.degrees_of_freedom = 2 * len(turns) - len(columns)
        variance = float(self.differences @ self.differences) / self.degrees_of_freedom
        variance = max(variance, _LEAST_SD**2)
        # The added term limits the variance of an element that no turn determines.
        normal = slopes.T @ slopes + _TINY * np.eye(len(columns))
        self.covariance = np.asarray(variance * np.linalg.inv(normal))
        self.deviations = np.sqrt(np.diag(self.covariance))


_LEAST_SD = 1e-4
"""Smallest plausible standard deviation of a direction of gravity, rad."""
_TINY = 1e-12
"""Smallest eigenvalue of the normal equations, rad^2."""


def _differences(
    turns: Sequence[Turn], ends: Sequence[tuple[Array, Array]], matrix: Array
) -> tuple[Array, Array]:
    """Return u_0 - R u_1 of all turns, shape (3 n,), and minus its derivative, shape (3 n, 9)."""
    values, slopes = [], []
    for turn, (before, after) in zip(turns, ends, strict=True):
        steps = _means(turn) * np.diff(turn.t_s)[:, None]
        q = _products(rotation.exp(steps @ matrix.T))
        turned = rotation.rotate(q[-1], after)
        # a change dG rotates the final direction by the sum of R dG m dt, in initial axes
        change = np.einsum("kai,kj->aij", rotation.to_matrix(q), steps).reshape(3, 9)
        values.append(before - turned)
        slopes.append(-np.cross(turned, change.T).T)
    return np.concatenate(values), np.concatenate(slopes)


def _means(turn: Turn) -> Array:
    """Return the rates without bias in the middle between two readings, shape (n - 1, 3)."""
    share = ((turn.t_s - turn.t_s[0]) / (turn.t_s[-1] - turn.t_s[0]))[:, None]
    rates = turn.rates - turn.before.rate - share * (turn.after.rate - turn.before.rate)
    return np.asarray(0.5 * (rates[1:] + rates[:-1]))


def _products(q: Array) -> Array:
    """Return the products of the first 1, 2, ... n quaternions, shape (n, 4)."""
    q, reach = q.copy(), 1
    while reach < len(q):
        q[reach:] = rotation.multiply(q[:-reach], q[reach:])
        reach *= 2
    return q


def _is_saturated(turn: Turn) -> bool:
    ends = (turn.rates.max(axis=0), turn.rates.min(axis=0))
    return any(
        abs(end[axis]) > _SATURATED
        and np.count_nonzero(turn.rates[:, axis] == end[axis]) >= _EQUAL_READINGS
        for end in ends
        for axis in range(3)
    )


def _check(estimate: GyroscopeScaleEstimate) -> None:
    """Reject scale factors that the turns do not determine."""
    if estimate.residual > LARGEST_RESIDUAL:
        raise SensorCalibrationError(
            "the directions of gravity computed from the gyroscope and measured by the "
            f"accelerometer differ by {degrees(estimate.residual):.1f} deg (RMS), expected less "
            f"than {degrees(LARGEST_RESIDUAL):g}: check unit and range of the rate in rig.toml, "
            "and turn the sensor more slowly"
        )
    deviations = np.diag(estimate.matrix_sd)
    axis = int(np.argmax(deviations))
    if deviations[axis] > LARGEST_SCALE_SD:
        raise SensorCalibrationError(
            f"the turns do not determine the scale about {'xyz'[axis]} (standard deviation "
            f"{100 * min(deviations[axis], 1.0):.1f} %, expected less than "
            f"{100 * LARGEST_SCALE_SD:g}): turn the sensor once around about {'xyz'[axis]} while "
            "this axis is level, from rest to rest"
        )
    error = np.abs(np.diag(estimate.matrix) - 1.0).max()
    if error > LARGEST_SCALE_ERROR:
        raise SensorCalibrationError(
            f"scale error {100 * error:.0f} %, expected at most {100 * LARGEST_SCALE_ERROR:.0f} %: "
            "check the unit of the rate in rig.toml, or replace the sensor"
        )


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def _rms(differences: Array) -> float:
    """Return the RMS length of the 3-vectors in a flat array."""
    return float(np.sqrt(3.0 * np.mean(differences**2)))
