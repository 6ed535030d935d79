"""Comparison of the rate of a stream with the configured rate.

The driver computes the divisor of its output from a nominal rate of the IMU, which is 400 or 800 Hz
depending on the model. If the IMU of a device has a different rate, the rate of the stream is
wrong, and the device reports no error. The module is pure.
"""

from __future__ import annotations

from statistics import median

from jointfit_daemon.model import DeviceEvent

_INTERVALS = 20
"""Number of intervals whose median is the period, so that lost messages do not change it."""
_WRONG = 0.05
"""Largest relative deviation from the configured rate that causes no warning."""


class RateCheck:
    """Measures the rate once, after the divisor of the output was received.

    Parameters
    ----------
    rate_hz : float
        Configured rate, Hz.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._divisor = 0
        self._last: int | None = None
        self._intervals: list[int] = []

    def start(self, divisor: int) -> None:
        """Begin a measurement. `divisor` is the rate divisor of the output."""
        self._divisor, self._last = divisor, None
        self._intervals.clear()

    def add(self, ticks: int) -> DeviceEvent | None:
        """Add the time of a message, ns; return a warning if the rate is not the configured one."""
        if not self._divisor:
            return None
        last, self._last = self._last, ticks
        if last is not None and ticks > last:
            self._intervals.append(ticks - last)
        if len(self._intervals) < _INTERVALS:
            return None

        divisor, self._divisor = self._divisor, 0
        rate_hz = 1e9 / median(self._intervals)
        if abs(rate_hz - self._rate_hz) <= _WRONG * self._rate_hz:
            return None
        imu_hz = rate_hz * divisor
        text = (
            f"sends at {rate_hz:.4g} Hz, expected {self._rate_hz:g} with divisor {divisor}: its "
            f"IMU runs at {imu_hz:.0f} Hz: set rate_hz = {rate_hz:.4g}, or set the IMU rate to "
            f"{self._rate_hz * divisor:.0f} Hz with VectorNav Control Center"
        )
        return DeviceEvent("warning", text, {"rate_hz": round(rate_hz, 2)})
