"""Lag of each sensor against the optical clock, from turning alone. Law: unsure means absent."""

from __future__ import annotations

from math import radians
from typing import TYPE_CHECKING

from jointfit_daemon.calibration.markers import visible
from jointfit_daemon.timing.lag import LagEstimate, LagSettings, estimate_lag

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from jointfit_daemon.calibration.trial import SensorTrack

PLATE = LagSettings(
    max_sigma_ns=2e6,
    min_r2=0.9,
    min_rate=radians(10),
    min_acceleration=radians(60),
    min_valid=0.5,
)
"""A rigid body turned by hand: noise and occlusion are all that may spoil it."""
SKIN = LagSettings(
    max_sigma_ns=5e6,
    min_r2=0.7,
    min_rate=radians(10),
    min_acceleration=radians(60),
    min_weight=0.5,
    min_valid=0.5,
)
"""Sensors and markers on skin move apart, so R² stays lower; 5 ms at 3 rad/s is still below 1°."""


def sensor_lags(
    t_ns: NDArray[np.int64],
    q: NDArray[np.float64],
    sensors: Mapping[str, SensorTrack],
    settings: LagSettings = PLATE,
) -> dict[str, LagEstimate]:
    """Estimate the lag of every sensor against one optical body, `timing.lag.estimate_lag`.

    Parameters
    ----------
    t_ns, q : ndarray, shapes (m,), (m, 4)
        The optical body; NaN where not seen.
    sensors : mapping
        Sensors fixed to that body.
    """
    if not visible(q).any():
        return {}
    return {
        name: estimate_lag(track.t_ns, track.q_world_sensor, t_ns, q, settings)
        for name, track in sensors.items()
    }


def usable_ns(lags: Mapping[str, LagEstimate]) -> dict[str, int]:
    """Return the lags, ns, that may be used."""
    return {name: round(lag.lag_ns) for name, lag in lags.items() if lag.refused is None}
