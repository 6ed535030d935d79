r"""The lag while it runs: many gated windows, one estimate, and a word when it steps.

Law: pure; one update a window. A Kalman filter on :math:`(\tau, \dot\tau)`. With both clocks mapped
the lag is constant, so the drift is small by assumption and a step is news: a device restarted, or
changed a filter.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.timing.lag._estimate import LagEstimate

DRIFT_NOISE = 0.02e-6
"""Random walk of the drift, per square root of a second."""
DRIFT_SD = 5e-6
"""Prior standard deviation of the drift: two mapped clocks."""
GATE_SIGMAS = 4.0
STEP_WINDOWS = 3
"""Refused windows in a row that agree are a step."""
AGREE_NS = 500_000.0


@dataclass(frozen=True, slots=True)
class TrackedLag:
    """The lag after a window."""

    lag_ns: float
    sigma_ns: float
    drift: float
    """d lag / dt, dimensionless; over 2e-6 is a fault of a clock fit."""
    drift_sigma: float
    step_ns: float | None = None
    """How far the lag stepped, if this window decided that it did."""


class LagTracker:
    """Follows one lag through overlapping windows.

    Parameters
    ----------
    window_s, hop_s : float
        Length of a window, and time from one to the next, s. Windows that overlap tell less than
        they seem to: their variance is taken ``window / hop`` times.
    """

    __slots__ = ("_drift", "_inflate", "_pp", "_pt", "_refused", "_t_ns", "_tau", "_tt")

    def __init__(self, *, window_s: float = 10.0, hop_s: float = 2.5) -> None:
        self._inflate = max(1.0, window_s / hop_s)
        self._t_ns: int | None = None
        self._tau = self._drift = 0.0
        self._tt = self._pt = self._pp = 0.0  # covariance of (tau, drift), s
        self._refused: list[float] = []

    def feed(self, t_ns: int, estimate: LagEstimate) -> TrackedLag | None:
        """Take the estimate of a window centered at `t_ns`; return the lag, None before the first.

        A refused estimate changes nothing but time.
        """
        if self._t_ns is not None:
            self._predict((t_ns - self._t_ns) * 1e-9)
            self._t_ns = t_ns
        if estimate.refused is not None:
            return self._now()
        tau, variance = estimate.lag_ns * 1e-9, self._inflate * (estimate.sigma_ns * 1e-9) ** 2
        if self._t_ns is None:
            self._start(t_ns, tau, variance)
            return self._now()
        innovation = tau - self._tau
        if abs(innovation) <= GATE_SIGMAS * sqrt(self._tt + variance):
            self._refused.clear()
            self._update(innovation, variance)
            return self._now()
        self._refused = [*self._refused[-(STEP_WINDOWS - 1) :], tau]
        agree = max(self._refused) - min(self._refused) <= AGREE_NS * 1e-9
        if len(self._refused) < STEP_WINDOWS or not agree:
            return self._now()
        self._start(t_ns, tau, variance)
        return self._now(step_ns=1e9 * innovation)

    def widen(self, sd_ns: float) -> None:
        """Doubt the lag, but keep it: a clock behind it began anew and may have settled elsewhere.

        The next window within `sd_ns` moves it as far as the data ask, and is no step.
        """
        self._tt += (sd_ns * 1e-9) ** 2
        self._refused = []

    def _start(self, t_ns: int, tau: float, variance: float) -> None:
        self._t_ns, self._tau, self._drift = t_ns, tau, 0.0
        self._tt, self._pt, self._pp = variance, 0.0, DRIFT_SD**2
        self._refused = []

    def _predict(self, dt: float) -> None:
        self._tau += dt * self._drift
        self._tt += dt * (2.0 * self._pt + dt * self._pp)
        self._pt += dt * self._pp
        self._pp += DRIFT_NOISE**2 * max(dt, 0.0)

    def _update(self, innovation: float, variance: float) -> None:
        total = self._tt + variance
        gain, drift_gain = self._tt / total, self._pt / total
        self._tau += gain * innovation
        self._drift += drift_gain * innovation
        self._pp -= drift_gain * self._pt
        self._pt -= gain * self._pt
        self._tt -= gain * self._tt

    def _now(self, step_ns: float | None = None) -> TrackedLag | None:
        if self._t_ns is None:
            return None
        return TrackedLag(
            1e9 * self._tau, 1e9 * sqrt(self._tt), self._drift, sqrt(self._pp), step_ns
        )
