"""Calibration of one inertial sensor: biases, scale factors and axes from guided movements.

Each step processes the readings of one movement and returns an estimate with its covariance.
`GyroscopeStep` needs rest, `AccelerometerStep` static poses, and `MagnetometerStep` free rotation.
The scale factors of the gyroscope are estimated from the turns between the static poses.
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
