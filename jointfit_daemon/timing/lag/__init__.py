"""Lag of an IMU behind motion capture, estimated from the angular rates of both systems.

``_estimate`` searches and fits the lag of a window, ``_gate`` contains the conditions under which
it is accepted, and ``_tracker`` follows the accepted lags over time.
"""

from jointfit_daemon.timing.lag._angular_rates import Rates, rates_from_orientations
from jointfit_daemon.timing.lag._estimate import (
    LagEstimate,
    estimate_in_steps,
    estimate_lag,
    estimate_lag_of_rates,
)
from jointfit_daemon.timing.lag._gate import LagSettings
from jointfit_daemon.timing.lag._tracker import LagTracker, TrackedLag

__all__ = [
    "LagEstimate",
    "LagSettings",
    "LagTracker",
    "Rates",
    "TrackedLag",
    "estimate_in_steps",
    "estimate_lag",
    "estimate_lag_of_rates",
    "rates_from_orientations",
]
