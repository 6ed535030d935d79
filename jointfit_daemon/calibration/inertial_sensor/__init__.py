"""Calibration of one inertial sensor: biases, scale factors and axes from guided movements.

Each step takes the readings of one movement and returns an estimate with its covariance:
`GyroscopeStep` at rest, `AccelerometerStep` in static poses, `MagnetometerStep` in free rotation.
"""

from jointfit_daemon.calibration.inertial_sensor._accelerometer import (
    AccelerometerEstimate,
    AccelerometerStep,
    fit_accelerometer,
)
from jointfit_daemon.calibration.inertial_sensor._directions import (
    DIRECTIONS,
    direction_names,
    nearest_direction,
)
from jointfit_daemon.calibration.inertial_sensor._gyroscope import GyroscopeEstimate, GyroscopeStep
from jointfit_daemon.calibration.inertial_sensor._magnetometer import (
    MagnetometerEstimate,
    MagnetometerStep,
    fit_magnetometer,
)
from jointfit_daemon.calibration.inertial_sensor._refusal import SensorCalibrationError
from jointfit_daemon.calibration.inertial_sensor._rest_blocks import SensorReading
from jointfit_daemon.calibration.inertial_sensor._step_progress import StepProgress

__all__ = [
    "DIRECTIONS",
    "AccelerometerEstimate",
    "AccelerometerStep",
    "GyroscopeEstimate",
    "GyroscopeStep",
    "MagnetometerEstimate",
    "MagnetometerStep",
    "SensorCalibrationError",
    "SensorReading",
    "StepProgress",
    "direction_names",
    "fit_accelerometer",
    "fit_magnetometer",
    "nearest_direction",
]
