"""Arc and flexion count of each joint from the inertial sensors during a functional movement.

The values guide the subject and are computed a few times per second. The fit does not use these
values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import inner_joints

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.model import Chain, Quaternion

SKIN_NOISE_M = 0.005
"""RMS soft-tissue artefact of a skin marker, m, which limits the accuracy of a functional joint
center.
"""

CORRELATION_S = 0.5
"""Correlation time of the soft-tissue artefact, s. One second therefore contains two independent
samples.
"""

MIN_ARC_RAD = math.radians(5.0)
"""Smallest arc from which the error of a joint center is predicted, rad."""

BENT_RAD = math.radians(30.0)
"""Rotation from the static pose above which a joint is flexed, rad."""
STRAIGHT_RAD = math.radians(15.0)
"""Rotation from the static pose below which a joint is extended again, rad."""


class _RotationRange:
    """Range of one orientation relative to a zero orientation, and the number of flexions."""

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
    """Arc and flexion count of each inner joint, from the sensors on both segments of the joint.

    For joints without markers, the error of the center is predicted from the arc φ. The prediction
    is the Cramér-Rao bound of a circle of unknown radius, ``26.8 σ / (√n φ²)``, and at least the
    value of a full circle. σ is `SKIN_NOISE_M`, and n is the number of independent samples of the
    soft-tissue artefact, which is smaller than the number of frames.
    """

    chain: Chain
    standing: Mapping[str, Quaternion] = field(default_factory=dict)
    """Orientation of each sensor in the static pose, which defines zero flexion. If a sensor of a
    pair is missing here, the first orientations of both sensors define zero flexion.
    """
    _seen: dict[tuple[str, str, str], _RotationRange] = field(default_factory=dict)
    """Range for each joint and pair of sensors. Each pair has its own range, because its zero
    depends on the sensor-to-segment alignments of both sensors.
    """

    def update(self, latest: Mapping[str, Quaternion]) -> None:
        """Process the newest orientation of each available sensor."""
        for _, joint, proximal, distal in inner_joints(self.chain):
            above, below = self.chain.sensors[proximal], self.chain.sensors[distal]
            a = next((sensor for sensor in above if sensor in latest), None)
            b = next((sensor for sensor in below if sensor in latest), None)
            if a is None or b is None:
                continue

            reach = self._seen.get((joint, a, b))
            if reach is None:
                zero = self.standing if {a, b} <= self.standing.keys() else latest
                reach = self._seen[joint, a, b] = _RotationRange(
                    _relative_rotation(zero[a], zero[b])
                )
            reach.take(_relative_rotation(latest[a], latest[b]))

    def arcs(self) -> dict[str, float]:
        """Return the largest arc of each inner joint since the start, rad."""
        arcs: dict[str, float] = {}
        for (joint, _, _), reach in self._seen.items():
            arcs[joint] = max(arcs.get(joint, 0.0), reach.arc)
        return arcs

    def bends(self) -> dict[str, int]:
        """Return the number of flexions of each inner joint since the start."""
        bends: dict[str, int] = {}
        for (joint, _, _), reach in self._seen.items():
            bends[joint] = bends.get(joint, 0) + reach.bends
        return bends

    def predicted_center_errors(self, elapsed_s: float) -> dict[str, float | None]:
        """Return the expected RMS error of each inner joint center, m; None for a small arc."""
        samples = max(1.0, elapsed_s / CORRELATION_S)
        return {
            joint: SKIN_NOISE_M * max(26.8 / arc**2, 2.0) / math.sqrt(samples)
            if arc >= MIN_ARC_RAD
            else None
            for joint, arc in self.arcs().items()
        }


def _relative_rotation(proximal: Quaternion, distal: Quaternion) -> np.ndarray:
    return rotation.multiply(rotation.conjugate(np.asarray(proximal)), np.asarray(distal))
