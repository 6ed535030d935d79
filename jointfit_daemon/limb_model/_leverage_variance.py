r"""Variance of a correction by distance from the training range and disagreement of the experts.

.. math:: \sigma_j^2(r, D) = a_j + b_j \max(0, \min(r, 30) - \tfrac12) + g_j D, \qquad
          D = \tfrac13 |c_a - c_b|^2

for each axis j, with r the leverage of a frame over its 0.995 quantile in training, and the
corrections :math:`c_a` and :math:`c_b` of the two experts.
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
"""Leverage ratio below which the variance is constant, for postures in the middle of the training
range."""


@dataclass(frozen=True, slots=True)
class LeverageVariance:
    """Variances of the three axes as a function of leverage ratio and disagreement."""

    inside: Vector
    """a: variance within the training range, rad², by axis."""
    outside: Vector
    """b: growth of the variance per unit of the leverage ratio, rad², by axis."""
    disagreement: Vector = (0.0, 0.0, 0.0)
    """g: growth of the variance per unit of the disagreement, by axis; zero in calibrations of
    earlier versions."""

    def at(self, ratio: float, disagreement: float = 0.0) -> Vector:
        """Return the standard deviations about x, y and z of the segment, rad.

        Parameters
        ----------
        ratio : float
            The larger leverage ratio of the two experts.
        disagreement : float
            Mean squared difference of their corrections over the axes, rad².
        """
        (ax, ay, az), (bx, by, bz) = self.inside, self.outside
        gx, gy, gz = self.disagreement
        r, d = max(min(ratio, FARTHEST) - WITHIN, 0.0), disagreement
        return (
            sqrt(ax + bx * r + gx * d),
            sqrt(ay + by * r + gy * d),
            sqrt(az + bz * r + gz * d),
        )

    @staticmethod
    def read(data: Mapping[str, Any]) -> LeverageVariance:
        """Return the variances of a JSON form."""
        return LeverageVariance(
            vector(data["inside"]),
            vector(data["outside"]),
            vector(data.get("disagreement", (0.0, 0.0, 0.0))),
        )
