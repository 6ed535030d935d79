r"""Kalman filter for the slow drift of one heading relative to another.

States are the heading error :math:`\delta` (rad), its rate :math:`\rho` (rad/s) and the bias
:math:`b` of the measurements (rad). The bias represents joint motion and soft-tissue artefacts,
which repeat with the movement and shift the measured heading as long as the movement lasts:

.. math:: \dot\delta = \rho,\quad \dot\rho = -\rho/\tau_\rho + w_1,\quad
          \dot b = -b/\tau_b + w_2,\quad z = \delta + b + n

where z is a measurement, and w_1, w_2 and n are white noise. Rate and bias are stationary
Ornstein-Uhlenbeck processes with the correlation times :math:`\tau_\rho` = :data:`RATE_S` and
:math:`\tau_b` = :data:`BIAS_S`. Because the bias decays, a persistent offset is attributed to
drift.

Invariant: without measurements the standard deviation grows. A measurement costs a few additions;
the filter runs once per second.
"""

from __future__ import annotations

from math import exp, radians, sqrt

import numpy as np

BLOCK_S = 1.0
"""Interval of the filter, s. Measurements within an interval are averaged."""
MIN_MEASUREMENTS = 5
"""Fewest measurements in an interval with which the filter is updated."""
RATE_SD = radians(3.0) / 60.0
"""Standard deviation of the drift rate of a heading without magnetometer, rad/s. It is 3 degrees
per minute.
"""
RATE_S = 300.0
"""Correlation time of the drift rate, s."""
BIAS_S = 15.0
"""Correlation time of the measurement bias, s. A movement rarely lasts longer than this time."""
START_SD = radians(1.0)
"""Standard deviation of the headings just after a static pose, rad."""
OUTLIER_SIGMA = 5.0
"""Largest accepted innovation, in standard deviations.

Slips and restarts cause larger innovations.
"""


class HeadingDriftFilter:
    """Estimates the drift of one relative heading.

    Parameters
    ----------
    spread : float
        Standard deviation of a measurement about its mean over a movement, rad.
    """

    def __init__(self, spread: float) -> None:
        self._spread2 = spread * spread
        self._x = np.zeros(3)
        bias2 = self._bias2 = 0.5 * self._spread2
        self._p = np.diag([START_SD**2, RATE_SD**2, bias2])
        self._sum, self._count = 0.0, 0
        self._t_ns: int | None = None
        self.heading = 0.0
        """Estimated heading error, rad."""
        self.sd = START_SD
        """Standard deviation of the estimated heading error, rad."""
        self.observed_sd = max(START_SD, 0.6 * spread)
        """Standard deviation of the estimate with regular measurements, rad. The residuals of the
        calibration already contain an error of this size.
        """
        self.rejected = 0
        """Number of consecutive intervals whose mean was rejected as an outlier."""

    def add_measurement(self, heading: float) -> None:
        """Add one measurement of the total heading error, rad."""
        self._sum += heading
        self._count += 1

    def step(self, t_ns: int) -> bool:
        """Advance to `t_ns`; return whether the estimate was updated (once per second)."""
        if self._t_ns is None:
            self._t_ns = t_ns
        dt = (t_ns - self._t_ns) * 1e-9
        if dt < BLOCK_S:
            return False

        # Prediction over dt.
        self._t_ns = t_ns
        rate_decay, bias_decay = exp(-dt / RATE_S), exp(-dt / BIAS_S)
        transition = np.array([[1.0, dt, 0.0], [0.0, rate_decay, 0.0], [0.0, 0.0, bias_decay]])
        noise = np.diag(
            [0.0, RATE_SD**2 * (1.0 - rate_decay**2), self._bias2 * (1.0 - bias_decay**2)]
        )
        self._x = transition @ self._x
        self._p = transition @ self._p @ transition.T + noise

        if self._count >= MIN_MEASUREMENTS:
            self._update(self._sum / self._count)
        self._sum, self._count = 0.0, 0
        self.heading, self.sd = float(self._x[0]), sqrt(float(self._p[0, 0]))
        return True

    def _update(self, heading: float) -> None:
        h = np.array([1.0, 0.0, 1.0])  # a measurement is heading error plus bias
        ph = self._p @ h
        s = float(h @ ph) + 0.5 * self._spread2
        innovation = heading - float(self._x[0] + self._x[2])
        if innovation * innovation > OUTLIER_SIGMA**2 * s:
            self.rejected += 1
            return

        self.rejected = 0
        gain = ph / s
        self._x = self._x + gain * innovation
        self._p = self._p - np.outer(gain, ph)
        self._p = 0.5 * (self._p + self._p.T)
