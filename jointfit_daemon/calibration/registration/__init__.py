"""Sensor-to-segment and world-to-world registration, stillness, lags and resampling."""

from jointfit_daemon.calibration.registration._lags import (
    BODY,
    NO_LAG,
    SensorLag,
    segment_lags,
    sensor_lags,
    tracked_lags,
)
from jointfit_daemon.calibration.registration._resampling import orientations_at, sensor_at
from jointfit_daemon.calibration.registration._sensor_mount import (
    fit_observable_alignment,
    fit_sensor_alignment,
)
from jointfit_daemon.calibration.registration._static_mean import (
    RobustMean,
    StaticLimits,
    component_mean,
    redonning_notes,
    robust_mean,
    static_mount,
    static_problems,
)
from jointfit_daemon.calibration.registration._stillness import StillnessMonitor

__all__ = [
    "BODY",
    "NO_LAG",
    "RobustMean",
    "SensorLag",
    "StaticLimits",
    "StillnessMonitor",
    "component_mean",
    "fit_observable_alignment",
    "fit_sensor_alignment",
    "orientations_at",
    "redonning_notes",
    "robust_mean",
    "segment_lags",
    "sensor_at",
    "sensor_lags",
    "static_mount",
    "static_problems",
    "tracked_lags",
]
