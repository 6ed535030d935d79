r"""Lag of an IMU behind motion capture, estimated from angular rates.

The estimate needs no world frame, heading, gravity or sensor-to-segment alignment, so it precedes
all other fits. The result contains a standard deviation, and the reason of a rejection if the data
do not determine the lag. The conditions for motion and fit are in ``_gate``. Missing data and a
failed search (`coarse_lags`) are rejected here.

Two rigidly connected bodies have the same angular rate up to a constant rotation and a gyro bias,

.. math:: g(t + \tau) = R\,\omega(t) + b + n ,

where g is the rate of the IMU and omega the rate from motion capture, each in its own body frame, R
is the rotation, b the bias and n the noise. The lag tau is the **IMU timestamp minus the mocap
timestamp of the same event**, so it is positive if the IMU is later. To align the systems, subtract
the lag from the IMU timestamps. The lag contains all delays that the clocks cannot observe:
constant transport delay, filters in both systems, and the definition of the exposure instant.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, nan
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import IDENTITY_ONE, as_quaternion
from jointfit_daemon.timing.lag._angular_rates import (
    Interpolant,
    low_pass,
    rates_from_orientations,
)
from jointfit_daemon.timing.lag._fine_fit import LEAST_PAIRS, fit_lag
from jointfit_daemon.timing.lag._gate import STAY_IN_VIEW, LagSettings, fit_fault, motion_fault

if TYPE_CHECKING:
    from collections.abc import Generator

    from numpy.typing import NDArray

    from jointfit_daemon.model import Quaternion, Vector
    from jointfit_daemon.timing.lag._angular_rates import Floats, Rates
    from jointfit_daemon.timing.lag._fine_fit import LagFit

NO_OVERLAP = "the tracks do not overlap"
_NYQUIST_SHARE = 0.4
"""Largest cut-off frequency as a fraction of the lower sample rate."""
_LEAST_OVERLAP = 0.5
"""Least overlap of the tracks for a correlation, as a fraction of the valid reference samples."""
_CANDIDATE = 0.5
"""Fraction of the best correlation above which a maximum is fitted."""
_CANDIDATES = 4
"""Largest number of fitted maxima."""
_TIE = 1e-3
"""Correlation difference below which lags are not ranked by their correlation. Periodic motion has
equal maxima, whose order would depend on rounding errors. The three-axis fits then select the lag.
"""
_SAME_S = 0.01
"""Distance below which two fitted lags are the same solution, s."""
_RIVAL = 1.5
"""Ratio of residual variances below which two solutions cannot be distinguished."""
_AGREE = 0.005
"""Expected relative difference between the rates that two correct systems measure."""


@dataclass(frozen=True, slots=True)
class LagEstimate:
    """Lag with its standard deviation and the diagnostics of the fit."""

    lag_ns: float
    """IMU timestamp minus reference timestamp of the same event, ns; NaN without a fit."""
    sigma_ns: float
    """Standard deviation, ns. It includes the effects of correlated residuals and of slowly varying
    timestamp errors."""
    r2: float
    """Coefficient of determination R², 1 - sum |residual|² / sum |omega|²."""
    refused: str | None
    """Reason for the rejection; None if the estimate is valid."""
    q_imu_ref: Quaternion = IDENTITY_ONE
    """Rotation from reference-body to IMU coordinates. If the motion has a single axis, the
    rotation about this axis is undetermined."""
    bias: Vector = (0.0, 0.0, 0.0)
    """Bias of the IMU's rate, rad/s."""
    residual_rms: float = nan
    """RMS residual per axis, rad/s."""
    rate_rms: float = nan
    """RMS angular rate of the reference, rad/s."""
    acceleration_rms: float = nan
    """RMS angular acceleration of the reference, rad/s²."""
    mean_weight: float = nan
    """Mean Huber weight of the residuals, 0 to 1."""
    valid_share: float = nan
    """Fraction of the duration that the rates cover, for the track with more gaps."""
    pairs: int = 0
    """Number of compared rates."""


def estimate_lag(
    imu_t_ns: NDArray[np.int64],
    imu_q: Floats,
    ref_t_ns: NDArray[np.int64],
    ref_q: Floats,
    settings: LagSettings | None = None,
) -> LagEstimate:
    """Estimate the lag between two tracks of orientations.

    The lag of filtered orientations differs from the lag of the gyro, because the output of an
    orientation filter leads the gyro by half the update interval inside the filter. Each lag
    applies only to the quantity from which it was estimated.

    Parameters
    ----------
    imu_t_ns, ref_t_ns : ndarray, shape (n,), (m,)
        Host instants, strictly increasing, ns.
    imu_q, ref_q : ndarray, shape (n, 4), (m, 4)
        q_world_body of each system, each in its own world. Rows with NaN are missing poses.
    settings : LagSettings, optional
        Search range and thresholds.

    Returns
    -------
    LagEstimate
        Lag. If the data do not determine it, ``refused`` contains the reason.
    """
    settings = settings or LagSettings()
    if min(np.size(imu_t_ns), np.size(ref_t_ns)) == 0:
        return LagEstimate(nan, inf, nan, "no data")
    origin = int(ref_t_ns[0])

    def rates(t_ns: NDArray[np.int64], q: Floats) -> Rates:
        return rates_from_orientations(t_ns, q, origin, bridge_s=settings.bridge_s)

    imu, ref = rates(imu_t_ns, imu_q), rates(ref_t_ns, ref_q)
    estimate = estimate_lag_of_rates(imu, ref, settings)
    if not estimate.r2 < settings.min_r2:
        return estimate

    # A low R² is typical of quaternions in the inverse convention.
    turned = rates(ref_t_ns, rotation.conjugate(ref_q))
    if estimate_lag_of_rates(imu, turned, settings).refused is not None:
        return estimate
    hint = f"{estimate.refused}; the fit succeeds if the quaternions of one system are conjugated"
    return replace(estimate, refused=hint)


def estimate_lag_of_rates(
    imu: Rates, ref: Rates, settings: LagSettings | None = None
) -> LagEstimate:
    """Estimate the lag between two tracks of angular rates with a common origin.

    `settings` has the same meaning as in ``estimate_lag``.
    """
    work = estimate_in_steps(imu, ref, settings)
    while True:
        try:
            next(work)
        except StopIteration as done:
            estimate: LagEstimate = done.value
            return estimate


def estimate_in_steps(
    imu: Rates, ref: Rates, settings: LagSettings | None = None
) -> Generator[None, None, LagEstimate]:
    """Run ``estimate_lag_of_rates`` in steps of a few milliseconds, for use in the event loop."""
    settings = settings or LagSettings()
    cutoff = min(settings.cutoff_hz, _NYQUIST_SHARE / max(imu.period_s, ref.period_s))
    valid = min(imu.valid_share, ref.valid_share)

    imu = low_pass(imu, cutoff)
    yield
    ref = low_pass(ref, cutoff)
    if min(imu.t_s.size, ref.t_s.size) < LEAST_PAIRS:
        refused = f"no gapless stretch of data: {STAY_IN_VIEW}"
        return LagEstimate(nan, inf, nan, refused, valid_share=valid)

    rate, acceleration = _rms(ref.w), _rms(Interpolant(ref).slopes)
    seen = LagEstimate(
        nan, inf, nan, None, rate_rms=rate, acceleration_rms=acceleration, valid_share=valid
    )
    too_little = motion_fault(rate, acceleration, settings)
    if too_little is not None:
        return replace(seen, refused=too_little)
    yield

    coarse, why = coarse_lags(imu, ref, settings)
    if why is not None:
        return replace(seen, refused=why)
    fits: list[LagFit] = []
    for start in coarse:
        yield
        found = yield from fit_lag(imu, ref, start, 1e-9 * settings.stamp_sd_ns)
        fits += [] if found is None else [found]
    if not fits:
        return replace(seen, refused=NO_OVERLAP)
    return _select_fit(seen, fits, settings)


def _select_fit(seen: LagEstimate, fits: list[LagFit], settings: LagSettings) -> LagEstimate:
    """Return the estimate from the best fit, with the reason if it is rejected."""
    fit, rival = _best_and_rival(fits, seen)
    estimate = replace(
        seen,
        lag_ns=1e9 * fit.tau_s,
        sigma_ns=1e9 * fit.sigma_s,
        r2=fit.r2,
        q_imu_ref=as_quaternion(rotation.from_matrix(fit.rotation).tolist()),
        bias=(float(fit.bias[0]), float(fit.bias[1]), float(fit.bias[2])),
        residual_rms=fit.residual_rms,
        mean_weight=fit.mean_weight,
        pairs=fit.pairs,
    )

    return replace(estimate, refused=fit_fault(fit, rival, seen.valid_share, settings))


def _best_and_rival(fits: list[LagFit], seen: LagEstimate) -> tuple[LagFit, LagFit | None]:
    """Return the best fit, and another lag that fits nearly as well, or None.

    Without a rival the fit with the smallest residual is best. With rivals the residuals are not
    decisive. The best fit is then the fit with the smallest lag, and the second result is the rival
    with the nearest lag.
    """
    best = min(fits, key=lambda fit: fit.residual_rms)
    limit = _RIVAL * max(best.residual_rms, _AGREE * seen.rate_rms) ** 2
    alike = [best, *(fit for fit in fits if fit is not best and fit.residual_rms**2 < limit)]
    if all(abs(fit.tau_s - best.tau_s) <= _SAME_S for fit in alike):
        return best, None

    # Lags are compared in whole milliseconds, because the sizes of two lags of opposite sign may
    # differ by rounding errors.
    nearest = min(alike, key=lambda fit: (round(1e3 * abs(fit.tau_s)), fit.tau_s < 0.0))

    # One lag differs from the best by more than _SAME_S, so at least one differs from the nearest
    # by more than half of it.
    others = [fit for fit in alike if abs(fit.tau_s - nearest.tau_s) > _SAME_S / 2]
    return nearest, min(
        others, key=lambda fit: (round(1e3 * abs(fit.tau_s - nearest.tau_s)), fit.tau_s < 0.0)
    )


def coarse_lags(
    imu: Rates, ref: Rates, settings: LagSettings
) -> tuple[tuple[float, ...], str | None]:
    """Return candidate lags, s, best first, and the reason if there are none.

    Candidates are maxima of the correlation of both rate magnitudes. The magnitudes do not depend
    on the rotation between the systems. At least one maximum that differs from the best by at most
    ``_TIE`` must lie inside the search range. A maximum at the border means that the lag is outside
    the range. The maxima within ``_TIE`` of the best are ranked by the size of the lag, including
    maxima at the border.
    """
    step, reach = settings.step_s, round(settings.span_s / settings.step_s)
    scores = _correlations(imu, ref, step, reach)
    best = float(scores.max())
    if not np.isfinite(best):
        return (), NO_OVERLAP

    padded = np.concatenate(([-inf], scores, [-inf]))
    peaks = np.flatnonzero((scores > padded[:-2]) & (scores >= padded[2:]))
    inside = peaks[(peaks > 0) & (peaks < scores.size - 1)]
    tied = peaks[scores[peaks] >= best - _TIE]
    if not np.isin(tied, inside).any():
        return (), (
            f"no common motion within {settings.span_s:g} s: check that the sensor sits on this "
            "body and that both clocks are converted to host time"
        )

    tied = tied[np.argsort(np.abs(tied - reach), kind="stable")]
    lesser = np.setdiff1d(inside[scores[inside] >= _CANDIDATE * best], tied)
    lesser = lesser[np.argsort(-scores[lesser], kind="stable")]
    ranked = np.concatenate((tied, lesser))[:_CANDIDATES]
    return tuple(((ranked - reach) * step).tolist()), None


def _correlations(imu: Rates, ref: Rates, step: float, reach: int) -> Floats:
    """Return the normalized correlation of the magnitudes at lags ``(i - reach) * step``."""
    grid = np.arange(ref.t_s[0], ref.t_s[-1], step)
    wide = grid[0] + step * np.arange(-reach, grid.size + reach)

    a, a_ok = _magnitude(ref, grid)
    b, b_ok = _magnitude(imu, wide)

    scores = np.full(2 * reach + 1, -inf)
    if not (a_ok.any() and b_ok.any()):
        return scores

    # The sums are over the common instants of every lag. The means are subtracted first, which
    # limits rounding errors.
    a, b = (np.where(ok, x - x[ok].mean(), 0.0) for x, ok in ((a, a_ok), (b, b_ok)))
    a_on, b_on = a_ok.astype(np.float64), b_ok.astype(np.float64)
    count = np.correlate(b_on, a_on, "valid")
    enough = count > max(2.0, _LEAST_OVERLAP * a_ok.sum())
    n = np.maximum(count, 1.0)
    sum_a, sum_b = np.correlate(b_on, a, "valid"), np.correlate(b, a_on, "valid")
    power_a = np.correlate(b_on, a * a, "valid") - sum_a * sum_a / n
    power_b = np.correlate(b * b, a_on, "valid") - sum_b * sum_b / n

    product = np.correlate(b, a, "valid") - sum_a * sum_b / n
    found = product / np.sqrt(np.maximum(power_a * power_b, 1e-300))
    scores[enough] = found[enough]
    return scores


def _magnitude(rates: Rates, t: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return |rate| at instants `t` by linear interpolation, and whether each value is valid."""
    _, inside = Interpolant(rates).locate(t)
    return np.interp(t, rates.t_s, np.linalg.norm(rates.w, axis=1)), inside


def _rms(vectors: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
