"""How much a functional movement has shown to the inertial sensors, while it goes on.

Law: a guide for the wearer, cheap enough to run a few times a second; the fit judges for itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.model import Chain, Quaternion

SKIN_NOISE_M = 0.005
"""Soft-tissue motion of a skin marker, m RMS: what limits a functional joint centre."""

CORRELATION_S = 0.5
"""Skin motion keeps its value about this long, so a second is worth two samples."""

BENT_RAD, STRAIGHT_RAD = math.radians(30.0), math.radians(15.0)
"""A joint bent when it turned further than the first from where it was in the static pose, and came
back when it is nearer than the second: what one step or one squat does to a knee."""


class _Reach:
    """How far one orientation went about its first value, and how often."""

    def __init__(self, first: np.ndarray) -> None:
        self._first = first
        self._low = self._high = np.zeros(3)
        self._bent = False
        self.bends = 0

    def take(self, q: np.ndarray) -> None:
        turned = rotation.log(rotation.multiply(rotation.conjugate(self._first), q))
        self._low, self._high = np.minimum(self._low, turned), np.maximum(self._high, turned)
        angle = float(np.sqrt(turned @ turned))
        if not self._bent and angle > BENT_RAD:
            self._bent, self.bends = True, self.bends + 1
        elif angle < STRAIGHT_RAD:
            self._bent = False

    @property
    def arc(self) -> float:
        return float(np.linalg.norm(self._high - self._low))


@dataclass(slots=True)
class MovementProgress:
    """Arc and bends of each inner joint, by the sensors on either side of it.

    Where no marker shows the joint center, the arc also predicts its error: the Cramér-Rao bound of
    a circle of unknown radius seen over an arc φ, ``26.8 σ / (√n φ²)`` capped at the full-circle
    value (bounds of a uniform arc), with n the number of independent looks at the skin, not of
    frames.
    """

    chain: Chain
    standing: Mapping[str, Quaternion] = field(default_factory=dict)
    """Orientation of each sensor in the static pose, from which bends are counted; of one that is
    not in it, the first that is looked at."""
    _seen: dict[tuple[str, str, str], _Reach] = field(default_factory=dict)
    """By joint and the two sensors looked at: each pair has a mount, so a zero, of its own."""

    def look(self, latest: Mapping[str, Quaternion]) -> None:
        """Take the newest orientation of each sensor that is alive."""
        for joint, above, below in zip(
            self.chain.joints[1:-1], self.chain.sensors, self.chain.sensors[1:], strict=False
        ):
            a = next((sensor for sensor in above if sensor in latest), None)
            b = next((sensor for sensor in below if sensor in latest), None)
            if a is not None and b is not None:
                reach = self._seen.get((joint, a, b))
                if reach is None:
                    zero = self.standing if {a, b} <= self.standing.keys() else latest
                    reach = self._seen[joint, a, b] = _Reach(_between(zero[a], zero[b]))
                reach.take(_between(latest[a], latest[b]))

    def arcs(self) -> dict[str, float]:
        """Return the largest arc each inner joint went through so far, rad."""
        arcs: dict[str, float] = {}
        for (joint, _, _), reach in self._seen.items():
            arcs[joint] = max(arcs.get(joint, 0.0), reach.arc)
        return arcs

    def bends(self) -> dict[str, int]:
        """Return how often each inner joint bent so far, whichever sensors saw it."""
        bends: dict[str, int] = {}
        for (joint, _, _), reach in self._seen.items():
            bends[joint] = bends.get(joint, 0) + reach.bends
        return bends

    def predicted_center_errors(self, elapsed_s: float) -> dict[str, float | None]:
        """Return the expected RMS error of each inner joint centre, m; None while it is useless."""
        looks = max(1.0, elapsed_s / CORRELATION_S)
        return {joint: _predicted(arc, looks) for joint, arc in self.arcs().items()}


def _between(proximal: Quaternion, distal: Quaternion) -> np.ndarray:
    return rotation.multiply(rotation.conjugate(np.asarray(proximal)), np.asarray(distal))


def _predicted(arc: float, looks: float) -> float | None:
    if arc < math.radians(5):
        return None
    factor = max(26.8 / arc**2, 2.0)
    return SKIN_NOISE_M * factor / math.sqrt(looks)
