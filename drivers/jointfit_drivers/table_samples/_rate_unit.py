r"""Check of the unit of angular rates by the motion of gravity in sensor axes.

The direction a of the specific force is constant in the world. In sensor axes it changes by

.. math:: \Delta a = -k \, (\omega \times a) \, \Delta t ,

where :math:`\omega` is the angular rate, rad/s, according to the configured unit, and :math:`\Delta
t` is the duration of a step. If this unit is correct, k is 1. The factor k is the slope of a
regression over the first rotations. Linear acceleration adds noise to the differences, but does not
bias the slope.

Invariant: the result depends only on the readings fed. The check reads no clock.
"""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING

from jointfit_daemon.units import STANDARD_GRAVITY
from jointfit_drivers.table_samples._units import UNITS

if TYPE_CHECKING:
    from jointfit_daemon.model import Vector

_STEPS = 300
"""Number of steps (pairs of successive readings) between two computations of the slope."""
_MOST_STEPS = 6000
"""Number of steps after which the check ends without a result, for example because the sensor
hardly rotated."""
_EXPLAINED = 0.5
"""Smallest share of the squared differences that the regression must explain."""
_LOW, _HIGH = 0.6, 1.7
"""Range of k in which the unit counts as correct."""
_FREE = 0.3
"""Largest relative deviation of the norm of the specific force from gravity, for both readings of a
step."""
_LONGEST_S = 0.1
"""Longest duration of a step, s."""


class RateUnitCheck:
    """Compares the angular rate with the specific force of one sensor."""

    def __init__(self) -> None:
        self._last: tuple[int, Vector, Vector] | None = None
        self._cross = self._predicted = self._observed = 0.0
        self._steps = 0
        self.slope: float | None = None
        """k if it is certain that k is out of range; None otherwise."""
        self.done = False
        """Whether the check has ended."""

    def take(self, t_ns: int, rate: Vector, force: Vector) -> None:
        """Add a reading: rate in rad/s and specific force in m/s^2, both in sensor axes."""
        length = sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
        if abs(length - STANDARD_GRAVITY) > _FREE * STANDARD_GRAVITY:
            self._last = None
            return
        a = (force[0] / length, force[1] / length, force[2] / length)
        last, self._last = self._last, (t_ns, rate, a)
        if last is None or not 0 < t_ns - last[0] <= _LONGEST_S * 1e9:
            return

        # The mean rate of two readings is used, because a rate may refer to the instant of its
        # stamp or to the interval before it.
        step_s = 0.5e-9 * (t_ns - last[0])
        wx, wy, wz = ((now + then) * step_s for now, then in zip(rate, last[1], strict=True))
        bx, by, bz = last[2]
        predicted = (wz * by - wy * bz, wx * bz - wz * bx, wy * bx - wx * by)
        observed = (a[0] - bx, a[1] - by, a[2] - bz)
        for p, d in zip(predicted, observed, strict=True):
            self._cross += p * d
            self._predicted += p * p
            self._observed += d * d
        self._steps += 1
        if self._steps % _STEPS:
            return

        self.done = self._steps >= _MOST_STEPS
        spread = self._predicted * self._observed
        if spread > 0.0 and self._cross**2 >= _EXPLAINED * spread:
            self.done = True
            slope = self._cross / self._predicted
            if not _LOW <= slope <= _HIGH:
                self.slope = slope

    def fitting_unit(self, configured: float) -> str | None:
        """Return the unit that brings k into range; None if there is none.

        `configured` is the SI value of the configured unit.
        """
        if self.slope is None:
            return None
        for unit, si in UNITS["rate"].items():
            if _LOW <= self.slope * configured / si <= _HIGH:
                return unit
        return None
