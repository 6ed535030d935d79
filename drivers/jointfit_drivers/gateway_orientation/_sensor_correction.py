"""Correction of raw readings by the stored calibration of a sensor.

Invariant: the correction of a reading depends on this reading only.
"""

from __future__ import annotations

from math import radians
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.model import Vector
    from jointfit_daemon.sensor_calibration import Rows, SensorCalibrationSettings
    from jointfit_drivers.gateway_orientation._filter import RawReading

_IDENTITY: Rows = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_ZERO: Vector = (0.0, 0.0, 0.0)


class SensorCorrection:
    """Corrects the readings of one sensor.

    Parameters
    ----------
    calibration
        Errors of the sensor, as the calibration determined them.
    """

    def __init__(self, calibration: SensorCalibrationSettings) -> None:
        x, y, z = calibration.gyroscope_bias_deg_s or _ZERO
        rate_bias = (radians(x), radians(y), radians(z))
        self._rate = (rate_bias, calibration.gyroscope_matrix or _IDENTITY)
        self._force = (
            calibration.accelerometer_bias or _ZERO,
            calibration.accelerometer_matrix or _IDENTITY,
        )
        self._field = (
            calibration.magnetometer_bias or _ZERO,
            calibration.magnetometer_matrix or _IDENTITY,
        )
        self.date = calibration.date
        """Date of the calibration."""

    def correct(self, reading: RawReading, *, field: bool) -> RawReading:
        """Return a corrected reading; if `field` is false, the magnetic field remains unchanged."""
        magnetic = reading.magnetic
        if field and magnetic is not None:
            magnetic = _map_vector(magnetic, *self._field)
        force = _map_vector(reading.force, *self._force)
        rate = _map_vector(reading.rate, *self._rate)
        return reading._replace(rate=rate, force=force, magnetic=magnetic)

    def correct_field(self, field: Vector) -> Vector:
        """Return a corrected magnetic field."""
        return _map_vector(field, *self._field)


def _map_vector(vector: Vector, bias: Vector, matrix: Rows) -> Vector:
    x, y, z = vector[0] - bias[0], vector[1] - bias[1], vector[2] - bias[2]
    (a, b, c), (d, e, f), (g, h, i) = matrix
    return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)
