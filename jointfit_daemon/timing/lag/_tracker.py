r"""Running lag estimate from many windows, with detection of steps.

A Kalman filter estimates the lag and its drift, :math:`(\tau, \dot\tau)`, with one update per
window. If both clocks are converted to host time, the lag is nearly constant, so the filter assumes
a small drift. A step indicates that a device restarted or changed a filter.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.timing.lag._estimate import LagEstimate

DRIFT_NOISE = 0.02e-6
"""Standard deviation of the random walk of the drift per square root of the time, 1/sqrt(s)."""
DRIFT_SD = 5e-6
"""Prior standard deviation of the drift between two clocks that are converted to host time,
dimensionless."""
GATE_SIGMAS = 4.0
"""Innovation, in standard deviations, above which a window may be the beginning of a step.
`LagSettings` contains the thresholds for a single window.
"""
STEP_WINDOWS = 3
"""Number of successive windows beyond `GATE_SIGMAS`, with consistent lags, that count as a step."""
AGREE_NS = 500_000.0
"""Largest range of consistent lags, ns."""


@dataclass(frozen=True, slots=True)
class TrackedLag:
    """Tracked lag after the update with one window."""

    lag_ns: float
    sigma_ns: float
    drift: float
    """Derivative of the lag with respect to time, dimensionless.

    A value above 2e-6 indicates a faulty clock fit.
    """
    drift_sigma: float
    step_ns: float | None = None
    """Size of the step, if this window confirmed one, ns."""


class LagTracker:
    """Kalman filter of one lag over overlapping windows.

    Parameters
    ----------
    window_s, hop_s : float
        Length of a window, and time from one window to the next, s. The variance of the estimates
        is multiplied by ``window_s / hop_s``, because overlapping windows are not independent.
    """

    __slots__ = ("_drift", "_inflate", "_pp", "_pt", "_refused", "_t_ns", "_tau", "_tt")

    def __init__(self, *, window_s: float = 10.0, hop_s: float = 2.5) -> None:
        self._inflate = max(1.0, window_s / hop_s)
        self._t_ns: int | None = None
        self._tau = self._drift = 0.0
        self._tt = self._pt = self._pp = 0.0  # covariance of (tau, drift): s^2, s, 1
        self._refused: list[float] = []

    def feed(self, t_ns: int, estimate: LagEstimate) -> TrackedLag | None:
        """Add the estimate of a window centered at `t_ns`; return the tracked lag.

        A rejected estimate only advances the time. The result is None before the first accepted
        estimate.
        """
        if self._t_ns is not None:
            dt, self._t_ns = (t_ns - self._t_ns) * 1e-9, t_ns
            self._tau += dt * self._drift
            self._tt += dt * (2.0 * self._pt + dt * self._pp)
            self._pt += dt * self._pp
            self._pp += DRIFT_NOISE**2 * max(dt, 0.0)

        if estimate.refused is not None:
            return self._now()
        tau, variance = estimate.lag_ns * 1e-9, self._inflate * (estimate.sigma_ns * 1e-9) ** 2
        if self._t_ns is None:
            self._start(t_ns, tau, variance)
            return self._now()

        innovation = tau - self._tau
        if abs(innovation) <= GATE_SIGMAS * sqrt(self._tt + variance):
            self._refused.clear()

            # Kalman update of lag and drift.
            total = self._tt + variance
            gain, drift_gain = self._tt / total, self._pt / total
            self._tau += gain * innovation
            self._drift += drift_gain * innovation
            self._pp -= drift_gain * self._pt
            self._pt -= gain * self._pt
            self._tt -= gain * self._tt

            return self._now()

        self._refused = [*self._refused[-(STEP_WINDOWS - 1) :], tau]
        agree = max(self._refused) - min(self._refused) <= AGREE_NS * 1e-9
        if len(self._refused) < STEP_WINDOWS or not agree:
            return self._now()
        self._start(t_ns, tau, variance)
        return self._now(step_ns=1e9 * innovation)

    def widen(self, sd_ns: float) -> None:
        """Increase the uncertainty of the lag by `sd_ns` after a clock restart.

        The next window can then change the lag without being detected as a step.
        """
        self._tt += (sd_ns * 1e-9) ** 2
        self._refused = []

    def _start(self, t_ns: int, tau: float, variance: float) -> None:
        self._t_ns, self._tau, self._drift = t_ns, tau, 0.0
        self._tt, self._pt, self._pp = variance, 0.0, DRIFT_SD**2
        self._refused = []

    def _now(self, step_ns: float | None = None) -> TrackedLag | None:
        if self._t_ns is None:
            return None
        return TrackedLag(
            1e9 * self._tau, 1e9 * sqrt(self._tt), self._drift, sqrt(self._pp), step_ns
        )
