"""Sensor-to-segment and world-to-world registration, stillness, lags and resampling."""

from jointfit_daemon.calibration.registration._lags import (
    NO_LAG,
    SKIN,
    ChosenLag,
    known_lag,
    seen_lags,
    segment_lags,
    sensor_lags,
    usable_ns,
)
from jointfit_daemon.calibration.registration._resampling import orientations_at, sensor_at
from jointfit_daemon.calibration.registration._sensor_mount import (
    fit_observable_alignment,
    fit_sensor_alignment,
)
from jointfit_daemon.calibration.registration._static_mean import (
    RobustMean,
    StaticLimits,
    redonning_problems,
    robust_mean,
    static_bias,
    static_problems,
)
from jointfit_daemon.calibration.registration._stillness import StillnessMonitor, still_from_rates

__all__ = [
    "NO_LAG",
    "SKIN",
    "ChosenLag",
    "RobustMean",
    "StaticLimits",
    "StillnessMonitor",
    "fit_observable_alignment",
    "fit_sensor_alignment",
    "known_lag",
    "orientations_at",
    "redonning_problems",
    "robust_mean",
    "seen_lags",
    "segment_lags",
    "sensor_at",
    "sensor_lags",
    "static_bias",
    "static_problems",
    "still_from_rates",
    "usable_ns",
]
