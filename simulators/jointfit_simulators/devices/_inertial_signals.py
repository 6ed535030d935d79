r"""Inertial and magnetic signals of a sensor that rotates in place.

The signals follow from two successive orientations, without noise:

.. math:: \omega = 2 \log(q_{k-1}^{*} q_k) / T, \qquad f = R_k^{T} (0, 0, g), \qquad
    m = R_k^{T} (0, \cos\delta, -\sin\delta)

ω is the angular rate, f the specific force, and m the magnetic field, all in sensor axes. q_k is
the orientation from sensor to world at time k, R_k its matrix, and log the logarithm of a
quaternion. T is the time between the two orientations, g the acceleration of gravity, and δ the
inclination of the magnetic field. A simulated device has an orientation but no position, so the
specific force contains gravity only. A device with `SensorErrors` measures these signals with bias,
scale errors and noise.
"""

from __future__ import annotations

from math import cos, radians, sin, sqrt
from random import Random
from typing import TYPE_CHECKING

from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_simulators.devices._rotations import TINY, rotation_vector
from jointfit_simulators.devices._sensor_errors import SensorErrors, Vector, VectorErrors

if TYPE_CHECKING:
    from jointfit_simulators.imu_device import Quaternion

GRAVITY = 9.81
"""Specific force at rest, m/s^2."""
DIP_RAD = radians(65.0)
"""Inclination of the magnetic field below the horizon, rad. The field has the magnitude 1 and
points north."""


class InertialSignals:
    """Signals of one sensor, computed from its orientations.

    Parameters
    ----------
    errors
        Errors of the sensor; None for exact measurements.
    """

    def __init__(self, errors: SensorErrors | None = None) -> None:
        self._errors = errors or SensorErrors()
        self._exact = errors is None
        self._random = Random(self._errors.seed)  # noqa: S311 - noise
        self._last: tuple[int, Quaternion] | None = None
        self._turn: Vector = (0.0, 0.0, 0.0)
        self._step_s = 0.0
        self._q: Quaternion = (1.0, 0.0, 0.0, 0.0)

    def update(self, device_ns: int, q_world_sensor: Quaternion) -> None:
        """Add the orientation at `device_ns`, which is later than the previous time."""
        if self._last is not None:
            at_ns, before = self._last
            self._turn = _rotation_between(before, q_world_sensor)
            self._step_s = (device_ns - at_ns) * 1e-9
        self._last, self._q = (device_ns, q_world_sensor), q_world_sensor

    @property
    def rate(self) -> Vector:
        """Angular rate over the last interval, sensor axes, rad/s; 0 before the second update."""
        x, y, z = self._turn
        step_s = self._step_s
        true = (x / step_s, y / step_s, z / step_s) if step_s > 0.0 else (0.0, 0.0, 0.0)
        return self._measure(true, self._errors.gyroscope)

    @property
    def force(self) -> Vector:
        """Specific force, sensor axes, m/s^2."""
        return self._measure(_to_sensor(self._q, (0.0, 0.0, GRAVITY)), self._errors.accelerometer)

    @property
    def field(self) -> Vector:
        """Magnetic field in sensor axes, with magnitude 1."""
        true = _to_sensor(self._q, (0.0, cos(DIP_RAD), -sin(DIP_RAD)))
        return self._measure(true, self._errors.magnetometer)

    def _measure(self, true: Vector, errors: VectorErrors) -> Vector:
        return true if self._exact else errors.measure(true, self._random)

    def value(self, item: int) -> tuple[float, ...] | None:
        """Return an Xbus item for the last interval; None if it is not an inertial signal."""
        step_s = self._step_s

        match item:
            case Item.RATE_OF_TURN:
                return self.rate
            case Item.DELTA_Q:
                x, y, z = self._turn if self._exact else _scale(self.rate, step_s)
                angle = sqrt(x * x + y * y + z * z)
                scale = sin(angle / 2.0) / angle if angle > TINY else 0.5
                return (cos(angle / 2.0), scale * x, scale * y, scale * z)
            case Item.ACCELERATION:
                return self.force
            case Item.DELTA_V:
                return _scale(self.force, step_s)
            case Item.MAGNETIC_FIELD:
                return self.field
            case _:
                return None


def _scale(vector: Vector, scale: float) -> Vector:
    return (vector[0] * scale, vector[1] * scale, vector[2] * scale)


def _rotation_between(before: Quaternion, after: Quaternion) -> Vector:
    """Return the rotation vector of conj(before) ⊗ after, rad."""
    a, b, c, d = before
    w, x, y, z = after
    v = (
        a * x - b * w - c * z + d * y,
        a * y + b * z - c * w - d * x,
        a * z - b * y + c * x - d * w,
    )
    return rotation_vector((a * w + b * x + c * y + d * z, *v))


def _to_sensor(q: Quaternion, v: Vector) -> Vector:
    """Return the sensor coordinates of a world vector."""
    w, x, y, z = q[0], -q[1], -q[2], -q[3]

    # t = 2 u x v, v' = v + w t + u x t, with u the vector part of q*
    tx, ty, tz = (
        2.0 * (y * v[2] - z * v[1]),
        2.0 * (z * v[0] - x * v[2]),
        2.0 * (x * v[1] - y * v[0]),
    )
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )
