"""Calibration of one inertial sensor: biases, scale factors and axes from guided movements.

Each step takes the readings of one movement and returns an estimate with its covariance:
`GyroscopeStep` at rest, `AccelerometerStep` in static poses, `MagnetometerStep` in free rotation.
The turns between the poses also yield the scale factors of the gyroscope.
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
from jointfit_daemon.calibration.inertial_sensor._gyroscope_scale import (
    GyroscopeScaleEstimate,
    fit_gyroscope_scale,
)
from jointfit_daemon.calibration.inertial_sensor._magnetometer import (
    MagnetometerEstimate,
    MagnetometerStep,
    fit_magnetometer,
)
from jointfit_daemon.calibration.inertial_sensor._refusal import SensorCalibrationError
from jointfit_daemon.calibration.inertial_sensor._rest_blocks import SensorReading
from jointfit_daemon.calibration.inertial_sensor._step_progress import StepProgress
from jointfit_daemon.calibration.inertial_sensor._turns import Turn, TurnCollector

__all__ = [
    "DIRECTIONS",
    "AccelerometerEstimate",
    "AccelerometerStep",
    "GyroscopeEstimate",
    "GyroscopeScaleEstimate",
    "GyroscopeStep",
    "MagnetometerEstimate",
    "MagnetometerStep",
    "SensorCalibrationError",
    "SensorReading",
    "StepProgress",
    "Turn",
    "TurnCollector",
    "direction_names",
    "fit_accelerometer",
    "fit_gyroscope_scale",
    "fit_magnetometer",
    "nearest_direction",
]
