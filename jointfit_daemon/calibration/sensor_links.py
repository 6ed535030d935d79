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
from itertools import combinations, product
from math import atan2, radians
from operator import le, mul
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Chain, Quaternion, Vector

Kind = Literal["pair", "joint"]

RIDGE = 1e-3
BLOCKS = 5
FEWEST_FRAMES = 100
LEAST_SPREAD = radians(0.3)
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
    ax, ay = _level_axis(a)
    bx, by = _level_axis(b)
    if ax * ax + ay * ay < LEAST_LEVEL or bx * bx + by * by < LEAST_LEVEL:
        return None
    return atan2(ax * by - ay * bx, ax * bx + ay * by)


def _level_axis(q: Quaternion) -> tuple[float, float]:
    w, x, y, z = q
    return 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)


# --- learning -----------------------------------------------------------------------------------


def fit_links(
    chain: Chain, sensors: Mapping[str, Array], q_static: Mapping[str, ArrayLike]
) -> tuple[SensorLink, ...]:
    """Learn all links of a limb from a movement.

    Parameters
    ----------
    chain : Chain
        Who sits where.
    sensors : mapping of str to ndarray, shape (n, 4)
        q_optical_segment as each sensor says it through its mount, at common instants in order
        of time; frames with NaN are left out.
    q_static : mapping
        q_optical_segment in the static pose, by segment.

    Returns
    -------
    tuple of SensorLink
        Empty where there are fewer than 100 complete frames.
    """
    links = []
    for i, group in enumerate(chain.sensors):
        near = _near(chain, i)
        links += [_fit("pair", (a, b), near, sensors) for a, b in combinations(group, 2)]
        if i + 1 < len(chain.sensors):
            q_a, q_b = (q_static[chain.segments[k]] for k in (i, i + 1))
            standing = float(_axis_headings(np.array([q_a]), np.array([q_b]))[0])
            links += [
                _fit("joint", (a, b), (b,), sensors, standing)
                for a, b in product(group, chain.sensors[i + 1])
            ]
    return tuple(link for link in links if link is not None)


def _near(chain: Chain, i: int) -> tuple[str, ...]:
    """Return the sensors of the next segment, the last looks back, a lone one at itself."""
    if len(chain.sensors) == 1:
        return chain.sensors[0]
    return chain.sensors[i + 1 if i + 1 < len(chain.sensors) else i - 1]


def _fit(
    kind: Kind,
    ends: tuple[str, str],
    near: tuple[str, ...],
    sensors: Mapping[str, Array],
    standing: float = 0.0,
) -> SensorLink | None:
    a, b = ends
    q_a, q_b, q_near = sensors[a], sensors[b], sensors[near[0]]
    if kind == "pair":
        wanted = rotation.log(rotation.multiply(rotation.conjugate(q_a), q_b))
    else:
        wanted = _wrapped(_axis_headings(q_a, q_b) - standing)[:, None]
    shown = _postures(q_a, q_near)
    known = np.isfinite(wanted).all(axis=1) & np.isfinite(shown).all(axis=1)
    shown, wanted = shown[known], wanted[known]
    if len(shown) < FEWEST_FRAMES:
        return None
    left = []
    for held in np.array_split(np.arange(len(shown)), BLOCKS):
        rest = np.ones(len(shown), dtype=bool)
        rest[held] = False
        left.append(wanted[held] - shown[held] @ _ridge(shown[rest], wanted[rest]))
    spread = float(np.sqrt(np.mean(np.concatenate(left) ** 2)))
    return SensorLink(
        a=a,
        b=b,
        kind=kind,
        near=near,
        weights=tuple(tuple(row) for row in _ridge(shown, wanted).T.tolist()),
        low=tuple(shown.min(axis=0).tolist()),
        high=tuple(shown.max(axis=0).tolist()),
        spread=float(max(spread, LEAST_SPREAD)),
        total=float(np.sqrt(np.mean(wanted**2))),
    )


def _ridge(shown: Array, wanted: Array) -> Array:
    """Return the weights, shape (10, components), without intercept: upright is upright."""
    scale = np.sqrt(np.mean(shown**2, axis=0)) + 1e-6
    g = shown / scale
    H = g.T @ g + RIDGE * len(g) * np.eye(g.shape[1])
    found: Array = np.linalg.solve(H, g.T @ wanted) / scale[:, None]
    return found


def _postures(q_a: Array, q_near: Array) -> Array:
    u, v = (np.stack(up_one(tuple(q.T)), axis=0) for q in (q_a, q_near))
    return np.stack(posture_one(tuple(u), tuple(v)), axis=1)


def _axis_headings(q_a: Array, q_b: Array) -> Array:
    ax, ay = _level_axis(tuple(q_a.T))
    bx, by = _level_axis(tuple(q_b.T))
    steep = (ax**2 + ay**2 < LEAST_LEVEL) | (bx**2 + by**2 < LEAST_LEVEL)
    found: Array = np.where(steep, np.nan, np.arctan2(ax * by - ay * bx, ax * bx + ay * by))
    return found


def _wrapped(angle: Array) -> Array:
    wrapped: Array = np.arctan2(np.sin(angle), np.cos(angle))
    return wrapped
