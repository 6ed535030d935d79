"""Stamps that never run backwards and never jump: what an estimate becomes on its way out.

Law: pure; knows of estimates only that they come with each sample and may be moved. Once synced, a
stamp approaches its estimate by at most 500 ppm of the time passed; an error too big for that is a
step, and whoever asks is told so.
"""

from __future__ import annotations

from typing import NamedTuple

STEP_NS = 5_000_000
"""An error of more than this is not slewed away."""
SLEW = 500e-6


class Stamp(NamedTuple):
    """Host time of a sample, and what it is worth."""

    t_ns: int
    """Host CLOCK_MONOTONIC, ns; greater than the stamp before, unless reordered or duplicate."""
    sigma_ns: float
    """Standard deviation, ns; the unseen smallest delay is not in it. May be inf at first."""
    synced: bool
    """False while the clock settles."""
    epoch: int
    """Grows whenever time before and after do not belong together."""
    duplicate: bool = False
    """The device gave this sample the time of the one before."""


Estimate = tuple[int, float, bool, float, float]
"""Host time, ns; skew; whether it is settled; standard deviation, ns; and the delay beyond the
fastest sample, or with echoes beyond the sampled instant, ns."""


class StampLine:
    """The stamps of one device in order.

    Parameters
    ----------
    period_ns : int
        Nominal time between two samples, ns: while unsynced, half of it is the least step.
    """

    __slots__ = ("_newest", "_period_ns", "last_t", "last_u")

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self.last_u: int | None = None
        """Device time of the last sample in order; None after a restart."""
        self.last_t: int | None = None
        """Its stamp, which a restart does not forget: time never runs backwards."""
        self._newest: int | None = None  # also of samples without device time

    @property
    def offset_ns(self) -> int | None:
        """Host minus device time at the last sample, ns; None before any."""
        if self.last_t is None or self.last_u is None:
            return None
        return self.last_t - self.last_u

    def stamp(self, u: int, target: int, skew: float, *, slew: bool) -> tuple[int, int]:
        """Return the stamp nearest to `target` that neither runs backwards nor, if asked, jumps.

        And the error that was too big to slew, ns: 0 if the stamp joins those before it.
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
        newest = self._newest  # as `forward` does: a call costs as much as the rest
        t = target if newest is None or target > newest else newest + 1
        self.last_u, self.last_t, self._newest = u, t, t
        return t, step

    def forward(self, t: int) -> int:
        """Return `t`, or the first instant after every stamp given so far."""
        if self._newest is not None and t <= self._newest:
            t = self._newest + 1
        self._newest = t
        return t
