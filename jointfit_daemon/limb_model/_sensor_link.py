r"""How the sensors of a limb lie to each other, posture by posture, as calibration saw it.

Law: what is learnt holds for skin, not for mounts or headings. Postures are told by gravity alone,
so no heading, and no drift of one, gets into them; all is counted from the static pose, so it
outlives sensors that are put on anew.

Two kinds of links are learnt. A pair is two sensors of one segment; what is predicted is their
rotation :math:`d = \log(q_a^* q_b)`. A joint is two sensors of neighboring segments; what is
predicted is the angle about the vertical between their flexion axes, which on a hinge is small and
repeats with posture. Either is linear in ten polynomials of the two segments' tilts (ridge), and
what it leaves over on blocks that were not fitted, contiguous in time, is its spread.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2
from operator import le, mul
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.model import Quaternion, Vector

Kind = Literal["pair", "joint"]

LEAST_LEVEL = 0.5
"""Squared horizontal part of a flexion axis below which its heading is not read."""
STRAY = 0.15
"""By how much of its range a tilt may leave what was seen before the link is less sure."""


@dataclass(frozen=True, slots=True)
class SensorLink:
    """Two sensors and what is expected between them."""

    a: str
    b: str
    kind: Kind
    near: tuple[str, ...]
    """Sensors whose tilt, with that of `a`, tells the posture: the first one alive."""
    weights: tuple[tuple[float, ...], ...]
    """By component of what is predicted (3 of a pair, 1 of a joint), ten each."""
    low: tuple[float, ...]
    high: tuple[float, ...]
    """Range of the polynomials in training."""
    spread: float
    """What the prediction leaves over on frames left out: RMS per component, rad."""
    total: float
    """RMS per component of what is predicted itself: what is left over without a posture, rad."""

    def expected(self, up_a: Vector, up_near: Vector | None) -> tuple[tuple[float, ...], float]:
        """Return what is expected in a posture, and the standard deviation per component, rad.

        Parameters
        ----------
        up_a, up_near : Vector
            The vertical in the frames of the two segments; None: not known.
        """
        if up_near is None:
            return (0.0,) * len(self.weights), self.total + self.spread
        seen, stray = posture_one(up_a, up_near), 0.0
        if not (all(map(le, self.low, seen)) and all(map(le, seen, self.high))):
            seen, stray = self._kept(seen)
        said = tuple([sum(map(mul, row, seen)) for row in self.weights])
        return said, self.spread + min(1.0, 2.0 * stray) * self.total

    def _kept(self, posture: tuple[float, ...]) -> tuple[tuple[float, ...], float]:
        """Return a posture kept within what was seen, and how far it strays from there."""
        kept, stray = [], 0.0
        for value, low, high in zip(posture, self.low, self.high, strict=True):
            kept.append(low if value < low else min(value, high))
            stray = max(stray, abs(value - kept[-1]) - STRAY * (high - low))
        return tuple(kept), stray

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "a": self.a,
            "b": self.b,
            "kind": self.kind,
            "near": list(self.near),
            "weights": [list(row) for row in self.weights],
            "low": list(self.low),
            "high": list(self.high),
            "spread": self.spread,
            "total": self.total,
        }

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> SensorLink:
        """Return the link that ``to_dict`` described."""
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
        )


# --- one frame ----------------------------------------------------------------------------------


def up_one(q: Quaternion) -> Vector:
    """Return the vertical in the frame of a segment, q_world_segment."""
    w, x, y, z = q
    return (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))


def posture_one(u: Vector, v: Vector) -> tuple[float, ...]:
    """Return ten polynomials of two tilts, all 0 when both segments stand upright."""
    ux, uy, uz = u
    vx, vy, vz = v
    return (
        ux, uy, 1.0 - uz, uy * uz, vx, vy, 1.0 - vz, vy * vz,
        uy * vz - uz * vy, 1.0 - uy * vy - uz * vz,
    )  # fmt: skip


def axis_heading_one(a: Quaternion, b: Quaternion) -> float | None:
    """Return the heading of b's flexion axis (its x) seen from that of a, rad.

    None where either axis is too steep to have one.
    """
    ax, ay = level_axis(a)
    bx, by = level_axis(b)
    if ax * ax + ay * ay < LEAST_LEVEL or bx * bx + by * by < LEAST_LEVEL:
        return None
    return atan2(ax * by - ay * bx, ax * bx + ay * by)


def level_axis(q: Quaternion) -> tuple[float, float]:
    w, x, y, z = q
    return 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)


# --- learning -----------------------------------------------------------------------------------
