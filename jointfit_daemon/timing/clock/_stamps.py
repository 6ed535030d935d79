"""Host timestamps of one device, monotonic and slewed toward the clock estimate.

Invariants: timestamps never decrease in the order of device time. Once the clock is synced, a
timestamp approaches its estimate by at most 500 ppm of the elapsed time. An error too large to be
slewed is a step, and is returned to the caller.
"""

from __future__ import annotations

from typing import NamedTuple

STEP_NS = 5_000_000
"""Largest error that is corrected by slewing, ns. A larger error is a step."""
SLEW = 500e-6
"""Largest slew rate (correction per elapsed time), dimensionless."""


class Stamp(NamedTuple):
    """Host time of a sample, with its standard deviation."""

    t_ns: int
    """Host CLOCK_MONOTONIC, ns; increasing, except for reordered and duplicate samples."""
    sigma_ns: float
    """Standard deviation, ns; inf before the first fit. The constant minimum delay is not included.
    """
    synced: bool
    """Whether the clock has settled."""
    epoch: int
    """Number that is incremented when earlier and later timestamps must not be combined."""
    duplicate: bool = False
    """Whether the sample has the same device time as the preceding sample."""


Estimate = tuple[int, float, bool, float, float]
"""Host time (ns), skew, whether the clock has settled, standard deviation (ns), and delay (ns).

The delay is measured from the fastest samples or, with echoes, from the sampling instant.
"""


class MonotonicStamps:
    """Timestamps of one device in order.

    Parameters
    ----------
    period_ns : int
        Nominal sample period, ns. Until the clock is synced, timestamps of consecutive samples are
        at least half a period apart.
    """

    __slots__ = ("_newest", "_period_ns", "last_t", "last_u")

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self.last_u: int | None = None
        """Device time of the last sample in order, ns; None after a restart."""
        self.last_t: int | None = None
        """Last timestamp, ns. A restart does not reset it, so that timestamps never decrease."""
        self._newest: int | None = None  # last timestamp, with or without device time

    @property
    def offset_ns(self) -> int | None:
        """Host time minus device time at the last sample, ns; None before the first sample."""
        if self.last_t is None or self.last_u is None:
            return None
        return self.last_t - self.last_u

    def stamp(self, u: int, target: int, skew: float, *, slew: bool) -> tuple[int, int]:
        """Return the permitted timestamp closest to `target`, and the step if one was needed.

        Parameters
        ----------
        u : int
            Device time of the sample, ns.
        target : int
            Estimated host time, ns.
        skew : float
            Derivative of host time minus device time with respect to device time, dimensionless.
        slew : bool
            Whether the rate of the correction is limited to ``SLEW``.

        Returns
        -------
        t_ns : int
            Timestamp, later than every timestamp before.
        step_ns : int
            Error too large to be slewed, ns; 0 if the timestamp continues the previous timestamps.
        """
        last_t, last_u, step = self.last_t, self.last_u, 0
        if last_t is not None and last_u is not None:
            passed = u - last_u
            if slew:
                due = last_t + passed + round(skew * passed)
                error, limit = target - due, round(SLEW * passed)
                if not -limit <= error <= limit:
                    if abs(error) > max(STEP_NS, limit):
                        step = error
                    else:
                        target = due + (limit if error > 0 else -limit)
            else:
                target = max(target, last_t + min(passed, self._period_ns) // 2)

        newest = self._newest  # `forward` is inlined: its call would cost as much as the rest
        t = target if newest is None or target > newest else newest + 1
        self.last_u, self.last_t, self._newest = u, t, t
        return t, step

    def forward(self, t: int) -> int:
        """Return `t`, or the first instant after all previous timestamps if `t` is not later."""
        if self._newest is not None and t <= self._newest:
            t = self._newest + 1
        self._newest = t
        return t
