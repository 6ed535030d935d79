r"""Lag of each sensor relative to the optical clock, estimated from rotation.

Sensors and markers on skin move with different soft tissue, and their relative motion biases the
lag. The standard deviation of the fit does not contain this bias. The measured lags of the sensors
of one segment are therefore modeled as

.. math:: m_i = \tau_i + c + d_i + n_i ,

where :math:`\tau_i` is the true lag of sensor i, n the noise of the fit, d the bias from the soft
tissue of each sensor, and c the bias from the soft tissue of the markers, common to all sensors.
The lags of the align phase were measured on a plate without soft tissue. The two kinds of lags are
weighted by their precision. A sensor with a known lag thus determines c, and c improves the lag of
a neighbor that was not on the plate. Lags that are too uncertain are absent from the results.
"""

from __future__ import annotations

from dataclasses import replace
from math import hypot, radians
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.limb_model import visible
from jointfit_daemon.timing.lag import LagEstimate, LagSettings, estimate_lag

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from jointfit_daemon.calibration._trial import SensorTrack

PLATE = LagSettings(
    max_sigma_ns=2e6,
    min_r2=0.9,
    min_rate=radians(10),
    min_acceleration=radians(60),
    min_valid=0.5,
)
"""Limits of the lag estimate on a rigid plate, where only noise and occlusion cause errors. The
defaults of `LagSettings` are the limits for live tracking.
"""
BODY = replace(PLATE, max_sigma_ns=5e6, min_r2=0.7, min_weight=0.5)
"""Limits of the lag estimate on the body, where soft tissue lowers R². An error of 5 ms at 3 rad/s
is still below 1°.
"""

SENSOR_TISSUE_SD_NS = 2e6
"""Standard deviation of the lag error that soft tissue under a sensor causes, ns."""
MARKER_TISSUE_SD_NS = 3e6
"""Standard deviation of the lag error that soft tissue under segment markers causes, ns."""
MAX_PRIOR_DEVIATION = 4.0
"""Difference between the lags on the plate and in the movement, in standard deviations, above which
a clock or filter must have changed. The lag from the movement is then used alone.
"""


class SensorLag(NamedTuple):
    """The lag that a calibration uses for one sensor."""

    lag_ns: int
    sigma_ns: float | None
    """Standard deviation, ns; None if unknown."""
    source: str
    """Source of the lag: ``known`` (configured), ``plate``, ``movement``, ``plate and movement``,
    ``tracked``, ``stored`` or ``none``.
    """


NO_LAG = SensorLag(0, None, "none")


def segment_lags(
    moving: Mapping[str, LagEstimate], prior: Mapping[str, tuple[int, float]]
) -> dict[str, SensorLag]:
    r"""Return the most probable lags of the sensors of one segment.

    .. math:: \hat\tau = (P + C^{-1})^{-1} (P p + C^{-1} m), \quad
              C = \mathrm{diag}(\sigma_i^2 + \sigma_d^2) + \sigma_c^2 1 1^T

    where m are the lags from the movement with standard deviations :math:`\sigma_i`, and p the lags
    from the align phase. P is the diagonal matrix of the inverse variances of p.
    :math:`\sigma_d` is `SENSOR_TISSUE_SD_NS`, and :math:`\sigma_c` is `MARKER_TISSUE_SD_NS`.

    Parameters
    ----------
    moving : mapping
        Lags measured in the movement; rejected estimates are ignored.
    prior : mapping
        Lag and standard deviation from the align phase, ns, by sensor; sensors may be absent.

    Returns
    -------
    dict
        Lag by sensor. Sensors without either lag are absent. A lag from movement alone that is
        below its standard deviation is considered noise and is also absent.
    """
    names = [name for name, lag in moving.items() if lag.refused is None]
    alone = {n: SensorLag(lag, sd, "plate") for n, (lag, sd) in prior.items() if n not in names}
    if not names:
        return alone
    found = np.array([moving[name].lag_ns for name in names])
    sigma = np.array([moving[name].sigma_ns for name in names])

    # Only prior lags that agree with the movement are used.
    trusted = {
        name: prior[name]
        for name, lag, own in zip(names, found, sigma, strict=True)
        if name in prior
        and abs(lag - prior[name][0])
        <= MAX_PRIOR_DEVIATION
        * hypot(own, prior[name][1], SENSOR_TISSUE_SD_NS, MARKER_TISSUE_SD_NS)
    }

    # Precision-weighted combination by the equation in the docstring.
    weight = np.array([trusted[n][1] ** -2.0 if n in trusted else 0.0 for n in names])
    prior_ns = np.array([trusted[n][0] if n in trusted else 0.0 for n in names])
    inverse = np.linalg.inv(np.diag(sigma**2 + SENSOR_TISSUE_SD_NS**2) + MARKER_TISSUE_SD_NS**2)
    covariance = np.linalg.inv(np.diag(weight) + inverse)
    lags = covariance @ (weight * prior_ns + inverse @ found)
    sds = np.sqrt(np.diag(covariance))
    return alone | {
        name: SensorLag(
            round(lag), float(sd), "plate and movement" if name in trusted else "movement"
        )
        for name, lag, sd in zip(names, lags.tolist(), sds.tolist(), strict=True)
        if name in trusted or abs(lag) > sd
    }


def tracked_lags(tracked: Mapping[str, tuple[float, float]]) -> dict[str, SensorLag]:
    """Return lags tracked at run time, with an uncertainty that includes soft tissue."""
    return {
        name: SensorLag(
            round(lag), hypot(sigma, SENSOR_TISSUE_SD_NS, MARKER_TISSUE_SD_NS), "tracked"
        )
        for name, (lag, sigma) in tracked.items()
    }


def sensor_lags(
    t_ns: NDArray[np.int64],
    q: NDArray[np.float64],
    sensors: Mapping[str, SensorTrack],
    settings: LagSettings = PLATE,
) -> dict[str, LagEstimate]:
    """Estimate the lag of every sensor relative to one optical body.

    Parameters
    ----------
    t_ns, q : ndarray, shapes (m,), (m, 4)
        Time stamps, ns, and orientations of the optical body in m frames; NaN if not visible.
    sensors : mapping
        Sensors that are fixed to the optical body.
    settings : LagSettings
        Search range and thresholds of the estimates.
    """
    if not visible(q).any():
        return {}
    return {
        name: estimate_lag(track.t_ns, track.q_world_sensor, t_ns, q, settings)
        for name, track in sensors.items()
    }
