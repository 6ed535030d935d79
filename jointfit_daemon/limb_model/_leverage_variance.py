r"""How wrong a correction is, axis by axis, from frames that its fit has not seen.

.. math:: \sigma_j^2(r) = a_j + b_j \max(0, \min(r, 30) - \tfrac12)

with r the leverage of a frame over the training's 0.995 quantile: how far the pose lies outside
what training has shown.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


FARTHEST = 30.0
"""Leverage ratios beyond tell nothing more."""
WITHIN = 0.5
"""Leverage ratios up to this are the heart of the training: there errors do not grow."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Variances of the three axes by distance from training."""

    inside: tuple[float, float, float]
    """a, rad^2."""
    outside: tuple[float, float, float]
    """b, rad^2."""

    def at(self, ratio: float) -> tuple[float, float, float]:
        """Return the standard deviations about x, y and z of the segment, rad."""
        (ax, ay, az), (bx, by, bz) = self.inside, self.outside
        r = max(min(ratio, FARTHEST) - WITHIN, 0.0)
        return (sqrt(ax + bx * r), sqrt(ay + by * r), sqrt(az + bz * r))

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {"inside": list(self.inside), "outside": list(self.outside)}

    @staticmethod
    def read(data: Mapping[str, Any]) -> Spread:
        """Return what `to_dict` described."""
        return Spread(_three(data["inside"]), _three(data["outside"]))


def _three(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
