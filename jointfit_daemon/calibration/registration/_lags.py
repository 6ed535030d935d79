r"""Lag of each sensor against the optical clock, from turning alone. Law: unsure means absent.

On skin, sensor and markers ride on different flesh, and the wobble of either passes for a lag. The
fit's own sigma does not know that, so what a movement says of a segment's sensors is taken as

.. math:: m_i = \tau_i + c + d_i + n_i ,

with n of the fit's sigma, d of each sensor's own flesh, c of the markers' flesh, shared by all.
What the align phase said of them, on a plate without flesh, is combined with it by precision. So a
sensor known from the plate tells c, and through it the lag of a neighbor that was not on the plate.
"""

from __future__ import annotations

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

FLESH_SD_NS = 2e6
"""Of a sensor's own flesh."""
MARKERS_SD_NS = 3e6
"""Of the flesh under a segment's markers, shared by its sensors."""
RULED_OUT = 4.0
"""Standard deviations between plate and movement from which on a clock or filter changed between
the two, and the later one counts."""


class ChosenLag(NamedTuple):
    """The lag a calibration uses for one sensor."""

    lag_ns: int
    sigma_ns: float | None
    """None where whoever said it did not say how sure it is."""
    source: str
    """``known``, ``plate``, ``movement``, ``plate and movement``, ``tracked``, ``stored`` or
    ``none``."""


NO_LAG = ChosenLag(0, None, "none")


def known_lag(lag_ns: int) -> ChosenLag:
    """Return a lag that was told from outside."""
    return ChosenLag(lag_ns, None, "known")


def segment_lags(
    moving: Mapping[str, LagEstimate], prior: Mapping[str, tuple[int, float]]
) -> dict[str, ChosenLag]:
    r"""Return the most probable lags of one segment's sensors.

    .. math:: \hat\tau = (P + C^{-1})^{-1} (P p + C^{-1} m), \quad
              C = \mathrm{diag}(\sigma_i^2 + \sigma_d^2) + \sigma_c^2 1 1^T

    Parameters
    ----------
    moving : mapping
        What the movement says; refused ones are left out.
    prior : mapping
        Lag and its standard deviation, ns, from the align phase, for any of them.

    Returns
    -------
    dict
        Sensors of which neither says anything are absent; so are those whose movement alone says
        less than its standard deviation: that is noise, and would set partners apart.
    """
    names = [name for name, lag in moving.items() if lag.refused is None]
    alone = {n: ChosenLag(lag, sd, "plate") for n, (lag, sd) in prior.items() if n not in names}
    if not names:
        return alone
    found = np.array([moving[name].lag_ns for name in names])
    sigma = np.array([moving[name].sigma_ns for name in names])
    trusted = {
        name: prior[name]
        for name, lag, own in zip(names, found, sigma, strict=True)
        if name in prior and abs(lag - prior[name][0]) <= RULED_OUT * _apart_sd(own, prior[name][1])
    }
    weight = np.array([trusted[n][1] ** -2.0 if n in trusted else 0.0 for n in names])
    said = np.array([trusted[n][0] if n in trusted else 0.0 for n in names])
    inverse = np.linalg.inv(np.diag(sigma**2 + FLESH_SD_NS**2) + MARKERS_SD_NS**2)
    covariance = np.linalg.inv(np.diag(weight) + inverse)
    lags = covariance @ (weight * said + inverse @ found)
    sds = np.sqrt(np.diag(covariance))
    return alone | {
        name: ChosenLag(
            round(lag), float(sd), "plate and movement" if name in trusted else "movement"
        )
        for name, lag, sd in zip(names, lags.tolist(), sds.tolist(), strict=True)
        if name in trusted or abs(lag) > sd
    }


def seen_lags(tracked: Mapping[str, tuple[float, float]]) -> dict[str, ChosenLag]:
    """Return lags seen while running, where sensors and markers ride on flesh, too."""
    return {
        name: ChosenLag(round(lag), hypot(sigma, FLESH_SD_NS, MARKERS_SD_NS), "tracked")
        for name, (lag, sigma) in tracked.items()
    }


def _apart_sd(sigma_ns: float, prior_sd_ns: float) -> float:
    return hypot(sigma_ns, prior_sd_ns, FLESH_SD_NS, MARKERS_SD_NS)


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
