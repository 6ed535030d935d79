r"""Expected relation between two sensors of a limb as a function of posture.

Posture is described by the direction of gravity alone, so headings and heading drift have no
effect. All quantities are relative to the static pose, so links remain valid after sensors are
re-donned.

There are two kinds of links. A *pair* link relates two sensors of one segment. It predicts the
rotation :math:`d = \log(q_a^* q_b)`. A *joint* link relates two sensors of neighboring segments. It
predicts the angle d about the vertical between their flexion axes, which on a hinge is small and
depends on posture. d is linear in ten polynomials :math:`\phi` of the tilts of the two segments,
:math:`d = W\phi`. Within the range of the movement the standard deviation of a component is the
residual :math:`\sigma_0` of the movement. Beyond the range it is

.. math::

    \sigma^2 = \sigma_0^2 + \lVert U \phi \rVert^2 + \lVert W (\phi - \phi_0) \rVert^2 / c

where :math:`U^\mathsf{T} U` is the covariance of the weights, and c the number of components.
:math:`\phi_0` are the polynomials limited to the range; beyond the range, :math:`d = W\phi_0`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, sqrt
from operator import le, mul, sub
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.model import Quaternion, Vector

LinkKind = Literal["pair", "joint"]

LEAST_LEVEL = 0.5
"""Smallest squared length of the horizontal part of a flexion axis, a unit vector, with which the
axis has a heading.
"""


@dataclass(frozen=True, slots=True)
class SensorLink:
    """Expected relation between two sensors."""

    a: str
    b: str
    kind: LinkKind
    near: tuple[str, ...]
    """Sensors of the neighboring segment or, if there is none, of the same segment. The tilt of the
    first available sensor and the tilt of `a` describe the posture.
    """
    weights: tuple[tuple[float, ...], ...]
    """Ten weights for each predicted component (3 for a pair, 1 for a joint)."""
    low: tuple[float, ...]
    """Smallest value of each polynomial in training."""
    high: tuple[float, ...]
    """Largest value of each polynomial in training."""
    spread: float
    """RMS residual per component on held-out frames, rad."""
    total: float
    """RMS per component of the predicted quantity, rad. If the posture is unknown, the standard
    deviation is `total` plus `spread`.
    """
    uncertainty: tuple[tuple[float, ...], ...] = ()
    """Factor U of the covariance of the weights of a component, rad, shape (10, 10); empty without
    training.
    """

    def predict(self, up_a: Vector, up_near: Vector | None) -> tuple[tuple[float, ...], float]:
        """Return the expected components in a posture and their standard deviation, rad.

        Parameters
        ----------
        up_a, up_near : Vector
            Vertical in the frames of the two segments; `up_near` is None if unknown. The expected
            components are then 0.
        """
        if up_near is None:
            return (0.0,) * len(self.weights), self.total + self.spread
        posture = posture_one(up_a, up_near)
        variance = self.spread * self.spread

        # The quantity is not extrapolated. The change that an extrapolation would cause is added to
        # the uncertainty.
        kept = posture
        if not (all(map(le, self.low, posture)) and all(map(le, posture, self.high))):
            kept = tuple(map(min, map(max, posture, self.low), self.high))
            beyond = tuple(map(sub, posture, kept))
            for row in self.weights:
                variance += sum(map(mul, row, beyond)) ** 2 / len(self.weights)
            for row in self.uncertainty:
                variance += sum(map(mul, row, posture)) ** 2
        expected = tuple([sum(map(mul, row, kept)) for row in self.weights])
        return expected, sqrt(variance)

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> SensorLink:
        """Return the link from its JSON form."""
        return SensorLink(
            a=data["a"],
            b=data["b"],
            kind=data["kind"],
            near=tuple(data["near"]),
            weights=tuple(tuple(row) for row in data["weights"]),
            low=tuple(data["low"]),
            high=tuple(data["high"]),
            spread=float(data["spread"]),
            total=float(data["total"]),
            uncertainty=tuple(tuple(row) for row in data.get("uncertainty", ())),
        )


# --- one frame ----------------------------------------------------------------------------------


def up_one(q: Quaternion) -> Vector:
    """Return the vertical in segment axes from q_world_segment."""
    w, x, y, z = q
    return (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))


def posture_one(u: Vector, v: Vector) -> tuple[float, ...]:
    """Return ten polynomials of two tilts, which are all 0 if both segments are upright."""
    ux, uy, uz = u
    vx, vy, vz = v
    return (
        ux, uy, 1.0 - uz, uy * uz, vx, vy, 1.0 - vz, vy * vz,
        uy * vz - uz * vy, 1.0 - uy * vy - uz * vz,
    )  # fmt: skip


def axis_heading_one(a: Quaternion, b: Quaternion) -> float | None:
    """Return the heading of the flexion axis (x) of b relative to the flexion axis of a, rad.

    The result is None if either axis is too steep for a heading.
    """
    ax, ay = level_axis(a)
    bx, by = level_axis(b)
    if ax * ax + ay * ay < LEAST_LEVEL or bx * bx + by * by < LEAST_LEVEL:
        return None
    return atan2(ax * by - ay * bx, ax * bx + ay * by)


def level_axis(q: Quaternion) -> tuple[float, float]:
    """Return the horizontal components of the flexion axis (x) of a segment."""
    w, x, y, z = q
    return 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)
