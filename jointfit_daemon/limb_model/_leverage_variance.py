r"""Variance of a correction as a function of the distance from the training range.

.. math:: \sigma_j^2(r) = a_j + b_j \max(0, \min(r, 30) - \tfrac12)

for each axis j. r is the leverage of a frame divided by the 0.995 quantile of the leverage in
training.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING, Any

from jointfit_daemon.limb_model._marker_cluster import vector

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.model import Vector

FARTHEST = 30.0
"""Leverage ratio above which the variance no longer increases."""
WITHIN = 0.5
"""Leverage ratio that limits the middle of the training range. Below this ratio the variance is
constant."""


@dataclass(frozen=True, slots=True)
class LeverageVariance:
    """Variances of the three axes as a function of the leverage ratio."""

    inside: Vector
    """Coefficients a: variance within the training range by axis, rad²."""
    outside: Vector
    """Coefficients b: increase of the variance per unit of the leverage ratio by axis, rad²."""

    def at(self, ratio: float) -> Vector:
        """Return the standard deviations about x, y and z of the segment, rad."""
        (ax, ay, az), (bx, by, bz) = self.inside, self.outside
        r = max(min(ratio, FARTHEST) - WITHIN, 0.0)
        return (sqrt(ax + bx * r), sqrt(ay + by * r), sqrt(az + bz * r))

    @staticmethod
    def read(data: Mapping[str, Any]) -> LeverageVariance:
        """Return the variances from their JSON form."""
        return LeverageVariance(vector(data["inside"]), vector(data["outside"]))
