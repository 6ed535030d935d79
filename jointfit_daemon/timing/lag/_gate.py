"""Gate of the lag: the conditions under which the lag of a window is accepted.

A window that fails a condition is refused. The reason names the finding, the threshold and the
remedy. It is published under the MQTT keys ``tracked_refused`` and ``quality.lag.ID.refused``. The
conditions, in order:

1. The markers move enough: rate and acceleration (`motion_fault`).
2. The search finds a common motion of sensor and markers (``_estimate.coarse_lags``).
3. The fit passes every threshold of `LagSettings`, and no other lag fits nearly as well
   (`fit_fault`).

The thresholds depend on the phase. The defaults of `LagSettings` are for live tracking.
``calibration/registration/_lags.py`` contains the thresholds for sensors on the calibration plate
and on the body. Two other decisions are not made here. ``_tracker`` detects steps of accepted lags,
and ``pipeline/sources/_lag_monitor.py`` reports lags that contradict the lag in use.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, radians
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.timing.lag._angular_rates import BRIDGE_S

if TYPE_CHECKING:
    from jointfit_daemon.timing.lag._fine_fit import LagFit

STAY_IN_VIEW = "stay in view of the cameras"
_MOVE_IRREGULARLY = "move faster and irregularly, about several axes"


@dataclass(frozen=True, slots=True)
class LagSettings:
    """Search range of the lag, and the thresholds that an estimate must pass.

    The defaults are for live tracking.
    """

    span_s: float = 0.15
    """Largest lag in the search, s; use 3 s if a clock is not converted to host time."""
    step_s: float = 0.004
    """Step of the search, s."""
    cutoff_hz: float = 10.0
    """Low-pass cut-off for both rates, Hz. It is limited to 0.4 of the lower sample rate."""
    bridge_s: float = BRIDGE_S
    """Longest gap of the orientations that is bridged, s."""
    stamp_sd_ns: float = 144_000.0
    """Standard deviation of the sawtooth error of the timestamps, ns. The default is a tick of 0.5
    ms divided by sqrt(12). Use 0 if the timestamps are exact.
    """
    min_rate: float = radians(30.0)
    """Least RMS angular rate of the reference, rad/s."""
    min_acceleration: float = radians(300.0)
    """Least RMS angular acceleration of the reference, rad/s²."""
    max_sigma_ns: float = 700_000.0
    """Largest standard deviation, ns. Windows of ordinary motion are far below this limit, so the
    random error of their standard deviation does not decide whether they are accepted.
    """
    min_r2: float = 0.98
    """Least R². Correct data on one rigid body reach 0.998; sensors on soft tissue reach less."""
    low_r2: str = (
        "different motions or a wrong convention; check that the sensor is on this body and "
        "attached firmly"
    )
    """Likely cause of an R² below `min_r2`, and its remedy."""
    min_weight: float = 0.7
    """Least mean Huber weight. Below this value the fit depends on a minority of the data."""
    min_valid: float = 0.8
    """Least fraction of the window without gaps."""
    max_bias: float = radians(10.0)
    """Largest rate bias, rad/s. A larger bias indicates wrong units or a wrong stream."""


def motion_fault(rate: float, acceleration: float, settings: LagSettings) -> str | None:
    """Return the reason for a refusal if the reference moves too little, or None.

    `rate` and `acceleration` are RMS values of the reference, rad/s and rad/s².
    """
    if not (rate < settings.min_rate or acceleration < settings.min_acceleration):
        return None
    return (
        f"too little motion: {np.degrees(rate):.1f} deg/s rms, {np.degrees(acceleration):.0f} "
        f"deg/s² rms; at least {np.degrees(settings.min_rate):.0f} and "
        f"{np.degrees(settings.min_acceleration):.0f} are needed: {_MOVE_IRREGULARLY}"
    )


def fit_fault(
    fit: LagFit, rival: LagFit | None, valid_share: float, settings: LagSettings
) -> str | None:
    """Return the reason for a refusal from the first condition that the fit fails, or None.

    `rival` is another lag that fits nearly as well, or None. `valid_share` is the fraction of the
    window without gaps.
    """
    sigma_ns, bias = 1e9 * fit.sigma_s, float(np.degrees(np.linalg.norm(fit.bias)))
    conditions = (
        (
            valid_share >= settings.min_valid,
            f"too many gaps: {100 * valid_share:.0f} % of the time is covered, at least "
            f"{100 * settings.min_valid:.0f} % are needed: {STAY_IN_VIEW}",
        ),
        (fit.converged, f"the fit did not converge: {_MOVE_IRREGULARLY}"),
        (
            fit.r2 >= settings.min_r2,
            f"R² {fit.r2:.3f} < {settings.min_r2:g}: {settings.low_r2}",
        ),
        (
            fit.mean_weight >= settings.min_weight,
            "too many outliers: check for swapped or occluded markers",
        ),
        (
            bias <= float(np.degrees(settings.max_bias)),
            f"rate bias too large, {bias:.1f} deg/s: check the unit of the rate",
        ),
        (
            sigma_ns <= settings.max_sigma_ns,
            f"too uncertain: {_sd_text(sigma_ns, settings.max_sigma_ns)}: {_MOVE_IRREGULARLY}",
        ),
        (
            abs(fit.tau_s) <= settings.span_s,
            f"{1e3 * fit.tau_s:.0f} ms is outside the searched span of {1e3 * settings.span_s:.0f} "
            "ms: check that both clocks are converted to host time",
        ),
    )
    failed = next((reason for passed, reason in conditions if not passed), None)
    if failed is not None or rival is None:
        return failed
    other_ms = 1e3 * rival.tau_s
    return f"the motion is periodic: a lag of {other_ms:.0f} ms fits as well; {_MOVE_IRREGULARLY}"


def _sd_text(sigma_ns: float, most_ns: float) -> str:
    if sigma_ns < inf:
        return f"{sigma_ns * 1e-6:.2f} ms > {most_ns * 1e-6:.2f} ms"
    return "only one moment of the movement determines the lag"
