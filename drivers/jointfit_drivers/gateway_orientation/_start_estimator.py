r"""Orientation, bias and magnetic field of an IMU whose orientation filter has just started.

The orientation filter VQF takes the vertical from a mean over 3 s, and the heading from the field
relative to that vertical. With a magnetic dip of 70 degrees, the error of the heading is 2.7 times
the error of the vertical. An unknown bias rotates heading and vertical, and VQF does not use the
field to estimate the bias. The Kalman filter of this module estimates vertical, heading and bias
together from gravity and field, in steps of `STEP_S`. The state of the filter is

.. math:: (\varphi, b, v, B_n, B_u)

The components are the error of the orientation, rad, in the world; the bias, rad/s; the velocity
relative to its mean, m/s; and the north and up components of the field. :math:`R` is the
orientation integrated from the angular rates with the assumed bias :math:`\hat b`. f is the
specific force, and T the interval of the readings. The sums extend over the readings of a step. The
vector g is gravity, upwards, and :math:`\Delta t` is the length of the step:

.. math::

    \varphi &\leftarrow \varphi - \sum R\,T\,(b - \hat b) \\
    v &\leftarrow v + \sum R f\,T - g\,\Delta t + \varphi \times \sum R f\,T

There are two observations. The first is v = 0, because the velocity of a body part is limited. The
second is the mean field of the step, :math:`\bar y = B + B \times \varphi` with the east, north and
up components :math:`B = (0, B_n, B_u)`. In both observations, a deviation lasts for about a second.
The variance of one step is therefore the variance of the deviation times `LASTING_S`, divided by
the length of the step.

Invariant: the result depends only on the readings added. The module uses no clock, no device and no
other filter.

Source: error-state Kalman filter, Solà 2017, arXiv:1711.02508.
"""

from __future__ import annotations

from math import cos, radians, sin, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.kinematics.rotation import skew, to_matrix
from jointfit_daemon.kinematics.rotation_scalar import multiply_one, normalize_one

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.model import Quaternion, Vector

STEP_S = 0.1
"""Length of one step of the filter, s."""
GRAVITY = 9.81
"""Gravity, m/s^2."""
SPEED_SD = 0.7
"""Expected standard deviation of the velocity of a body part about its mean, m/s."""
SPEED_KNOWN_S = 1.0
"""Weight of `SPEED_SD` in the estimated standard deviation of the velocity, expressed as the
duration of observations that have the same weight, s."""
FIELD_SD = 0.03
"""Standard deviation of the field during motion, relative to its strength."""
FIELD_LIMIT = 0.1
"""Deviation of the field above which its weight decreases, relative to its strength."""
LASTING_S = 1.0
"""Correlation time of deviations of velocity and field, s."""
SCALE_SD = 0.002
"""Relative standard deviation of the scale and of the axis directions of a gyroscope."""
FORCE_SD = 0.3
"""Standard deviation of the error of an accelerometer during motion, m/s^2."""
REVERSAL_S = 0.3
"""Time after which a movement reverses, s. It is the correlation time of the errors with the
standard deviations `SCALE_SD` and `FORCE_SD`."""
RATE_NOISE = radians(0.02)
"""Noise of the integrated angle of a gyroscope, rad per root second."""
TILT_SD = radians(1.0)
"""Standard deviation of the first estimate of the vertical if the velocity of the sensor does not
change, rad."""
HEADING_SD = 0.5
"""Standard deviation of the first estimate of the heading, rad."""

_PHI, _BIAS, _VELOCITY, _FIELD = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 11)
_SIZE = 11
_HALF_TURN = np.array((-1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0))
"""Factors of the state variables if the world is rotated by half a turn about the vertical."""


class StartReading(NamedTuple):
    """One reading, with the orientation integrated from the gyroscope."""

    q: Quaternion
    """Orientation integrated from the angular rates; its first value is arbitrary."""
    rate: Vector
    """Angular rate, rad/s."""
    force: Vector
    """Specific force, m/s^2."""
    field: Vector
    """Magnetic field; zeros if the reading has no field."""


class StartEstimator:
    """Kalman filter for the start of one IMU.

    Parameters
    ----------
    readings : sequence of StartReading
        Readings since the start of the filter. At least some of them contain a field.
    period_s : float
        Interval of the readings, s.
    assumed : ndarray, shape (3,)
        Bias that was assumed when the orientations of these readings were integrated, rad/s.
    bias : ndarray, shape (3,)
        Expected gyroscope bias, rad/s.
    bias_sd : float
        Standard deviation of the expected bias, rad/s.
    """

    def __init__(
        self,
        readings: Sequence[StartReading],
        period_s: float,
        assumed: NDArray[np.float64],
        bias: NDArray[np.float64],
        bias_sd: float,
    ) -> None:
        self._period_s = period_s
        self._step = max(1, round(STEP_S / period_s))
        self._pending: list[StartReading] = []

        # The vertical is the mean specific force in the frame of the integrated orientation.
        q, force, field = (np.array([part[kind] for part in readings]) for kind in (0, 2, 3))
        matrices = to_matrix(q)
        up = np.einsum("nij,nj->i", matrices, force)
        self.q_world_gyro = _shortest_rotation(up / np.linalg.norm(up))

        # The horizontal part of the median field points north. Short disturbances do not change the
        # median.
        known = field.any(axis=1)
        self._strength = float(np.median(np.linalg.norm(field[known], axis=1)))
        usual = np.median(np.einsum("nij,nj->ni", matrices[known], field[known]), axis=0)
        east, north, up_part = to_matrix(self.q_world_gyro) @ usual
        half = 0.5 * float(np.arctan2(east, north))
        self.q_world_gyro = multiply_one((cos(half), 0.0, 0.0, sin(half)), self.q_world_gyro)
        self._field = np.array((np.hypot(east, north), up_part))

        # The filter runs twice. The second pass uses the standard deviation of the velocity that
        # the first pass estimated.
        begins = range(0, len(readings) - self._step + 1, self._step)
        parts = [readings[begin : begin + self._step] for begin in begins]
        start = (self.q_world_gyro, self._field)
        speed_sd = SPEED_SD
        for _ in range(2):
            self.q_world_gyro, self._field = start[0], start[1].copy()
            self.bias, self._velocity = np.array(bias), np.zeros(3)

            # A change of velocity during the readings tilts their mean specific force.
            tilt_sd = TILT_SD + sqrt(2.0) * speed_sd / (GRAVITY * (len(readings) * period_s))
            variances = np.empty(_SIZE)
            variances[_PHI] = (tilt_sd**2, tilt_sd**2, HEADING_SD**2)
            variances[_BIAS] = bias_sd**2
            variances[_VELOCITY] = speed_sd**2
            variances[_FIELD] = self._strength**2
            self.covariance = np.diag(variances)

            self._squared, self._observed_s = speed_sd**2 * SPEED_KNOWN_S, SPEED_KNOWN_S
            for part in parts:
                self._update(part, assumed)
            speed_sd = self.speed_sd

    @property
    def orientation_sd(self) -> float:
        """Standard deviation of the angle of the orientation, rad."""
        return sqrt(float(np.trace(self.covariance[_PHI, _PHI])))

    @property
    def speed_sd(self) -> float:
        """Standard deviation of the velocity about its mean, per axis, m/s."""
        return sqrt(self._squared / self._observed_s)

    @property
    def bias_sd(self) -> float:
        """Standard deviation of the bias about its least certain axis, rad/s."""
        return sqrt(float(np.linalg.eigvalsh(self.covariance[_BIAS, _BIAS])[-1]))

    @property
    def bias_covariance(self) -> NDArray[np.float64]:
        """Covariance of the bias, shape (3, 3), rad^2/s^2."""
        return self.covariance[_BIAS, _BIAS]

    def add(self, reading: StartReading) -> bool:
        """Add the next reading, integrated with the current bias; return whether it ends a step."""
        self._pending.append(reading)
        if len(self._pending) < self._step:
            return False
        self._update(self._pending, self.bias.copy())
        self._pending.clear()
        return True

    def _update(self, readings: Sequence[StartReading], assumed: NDArray[np.float64]) -> None:
        """Update the filter with the readings of one step, integrated with the bias `assumed`."""
        q, rate, force, field = (np.array(kind) for kind in zip(*readings, strict=True))
        duration_s = len(readings) * self._period_s
        matrices = to_matrix(self.q_world_gyro) @ to_matrix(q)

        # Prediction of the state.
        turn = matrices.sum(axis=0) * self._period_s
        impulse = np.einsum("nij,nj->i", matrices, force) * self._period_s
        error = np.zeros(_SIZE)
        error[_PHI] = -turn @ (self.bias - assumed)
        self._velocity += impulse - (0.0, 0.0, GRAVITY * duration_s)
        self._velocity += np.cross(error[_PHI], impulse)

        transition = np.eye(_SIZE)
        transition[_PHI, _BIAS] = -turn
        transition[_VELOCITY, _PHI] = -skew(impulse)
        covariance = transition @ self.covariance @ transition.T
        squared_rate = float(np.mean(np.sum(rate**2, axis=1)))
        angle_variance = SCALE_SD**2 * squared_rate * REVERSAL_S + RATE_NOISE**2
        covariance[_PHI, _PHI] += angle_variance * duration_s * np.eye(3)
        covariance[_VELOCITY, _VELOCITY] += FORCE_SD**2 * REVERSAL_S * duration_s * np.eye(3)

        # Observation of the velocity and, if it was measured, of the field.
        known = field.any(axis=1)
        has_field = bool(known.any())
        count = 6 if has_field else 3
        observed, innovation = np.zeros((count, _SIZE)), np.empty(count)
        variances = np.empty(count)
        observed[:3, _VELOCITY] = np.eye(3)
        innovation[:3] = -self._velocity
        variances[:3] = self.speed_sd**2 * LASTING_S / duration_s
        if has_field:
            world = np.array((0.0, *self._field))
            observed[3:, _PHI] = skew(world)
            observed[3:, _FIELD] = np.eye(3)[:, 1:]
            mean = np.einsum("nij,nj->i", matrices[known], field[known]) / np.sum(known)
            innovation[3:] = mean - world - observed[3:, _PHI] @ error[_PHI]

            # A disturbed field has a larger variance.
            off = float(np.linalg.norm(innovation[3:])) / (FIELD_LIMIT * self._strength)
            field_sd = FIELD_SD * self._strength * max(1.0, off)
            variances[3:] = field_sd**2 * LASTING_S / duration_s

        crossed = observed @ covariance
        gain = np.linalg.solve(crossed @ observed.T + np.diag(variances), crossed).T
        error += gain @ innovation
        covariance -= gain @ crossed
        self.covariance = 0.5 * (covariance + covariance.T)
        self._correct(error, duration_s)

    def _correct(self, error: NDArray[np.float64], duration_s: float) -> None:
        """Add an estimated error to the estimates."""
        x, y, z = (0.5 * error[_PHI]).tolist()
        self.q_world_gyro = normalize_one(multiply_one((1.0, x, y, z), self.q_world_gyro))
        self.bias += error[_BIAS]
        self._velocity += error[_VELOCITY]
        self._field += error[_FIELD]

        # The first heading was wrong by more than 90 degrees, so the world is rotated by half a
        # turn.
        if self._field[0] < 0.0:
            self.q_world_gyro = multiply_one((0.0, 0.0, 0.0, 1.0), self.q_world_gyro)
            self._velocity[:2] *= -1.0
            self._field[0] *= -1.0
            self.covariance *= np.outer(_HALF_TURN, _HALF_TURN)

        self._squared += float(np.mean(self._velocity**2)) * duration_s
        self._observed_s += duration_s


def _shortest_rotation(up: NDArray[np.float64]) -> Quaternion:
    """Return the shortest rotation from a unit vector to +z."""
    x, y, z = up.tolist()
    if z < -1.0 + 1e-12:
        return (0.0, 1.0, 0.0, 0.0)
    w = sqrt(0.5 * (1.0 + z))
    return (w, 0.5 * y / w, -0.5 * x / w, 0.0)
