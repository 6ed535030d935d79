r"""The slow drift of one heading against another, from looks that are noisy and biased by skin.

Law: pure; a look costs a few additions, once a second a filter of three states runs. What is not
looked at grows doubtful.

States: heading error (rad), its rate (rad/s), and the bias of the looks (rad): joints and skin that
repeat with the movement shift what is seen for as long as it goes on.

.. math:: \dot\delta = \rho,\quad \dot\rho = -\rho/\tau_\rho + w_1,\quad
          \dot b = -b/\tau_b + w_2,\quad z = \delta + b + n

Rate and bias are stationary (Ornstein and Uhlenbeck) with the standard deviations given; the bias
fades within :data:`BIAS_S`, so a drift is what stays, and is believed only as far as it must be.
"""

from __future__ import annotations

from math import exp, radians, sqrt

import numpy as np

BLOCK_S = 1.0
LEAST_LOOKS = 5
RATE_SD = radians(3.0) / 60.0
"""Of the drift of a heading without a magnetometer, rad/s: 3 degrees a minute."""
RATE_S = 300.0
BIAS_S = 15.0
START_SD = radians(1.0)
"""Of the headings that a static pose sets."""
OUTLIER = 5.0
"""Sigmas beyond which a look tells of something else: a slip, a restart."""


class HeadingDrift:
    """Follows one relative heading.

    Parameters
    ----------
    spread : float
        Standard deviation of a look about its mean over a movement, rad.
    """

    def __init__(self, spread: float) -> None:
        self._spread2 = spread * spread
        self._x = np.zeros(3)
        bias2 = self._bias2 = 0.5 * self._spread2
        self._p = np.diag([START_SD**2, RATE_SD**2, bias2])
        self._sum, self._count = 0.0, 0
        self._t_ns: int | None = None
        self.heading = 0.0
        """Estimate of the heading error now, rad."""
        self.sd = START_SD
        """Its standard deviation, rad."""
        self.least_sd = max(START_SD, 0.6 * spread)
        """What it comes to while the drift is looked at: part of what calibration saw."""
        self.refused = 0
        """Looks, one a second, that contradicted the drift so far and were not used, in a row."""

    def look(self, seen: float) -> None:
        """Take one look at the whole heading error, rad."""
        self._sum += seen
        self._count += 1

    def step(self, t_ns: int) -> bool:
        """Let time go on; work once a second. Return whether the estimate is a new one."""
        if self._t_ns is None:
            self._t_ns = t_ns
        dt = (t_ns - self._t_ns) * 1e-9
        if dt < BLOCK_S:
            return False
        self._t_ns = t_ns
        self._predict(dt)
        if self._count >= LEAST_LOOKS:
            self._update(self._sum / self._count)
        self._sum, self._count = 0.0, 0
        self.heading, self.sd = float(self._x[0]), sqrt(float(self._p[0, 0]))
        return True

    def _predict(self, dt: float) -> None:
        keep_rate, keep_bias = exp(-dt / RATE_S), exp(-dt / BIAS_S)
        flow = np.array([[1.0, dt, 0.0], [0.0, keep_rate, 0.0], [0.0, 0.0, keep_bias]])
        noise = np.diag(
            [0.0, RATE_SD**2 * (1.0 - keep_rate**2), self._bias2 * (1.0 - keep_bias**2)]
        )
        self._x = flow @ self._x
        self._p = flow @ self._p @ flow.T + noise

    def _update(self, seen: float) -> None:
        h = np.array([1.0, 0.0, 1.0])
        ph = self._p @ h
        s = float(h @ ph) + 0.5 * self._spread2
        innovation = seen - float(self._x[0] + self._x[2])
        if innovation * innovation > OUTLIER**2 * s:
            self.refused += 1
            return
        self.refused = 0
        gain = ph / s
        self._x = self._x + gain * innovation
        self._p = self._p - np.outer(gain, ph)
        self._p = 0.5 * (self._p + self._p.T)
