"""How much a functional movement has shown so far, while it goes on.

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


@dataclass(slots=True)
class MovementProgress:
    """Arc covered by each inner joint and the joint-centre error to be expected from it.

    The prediction is the Cramér-Rao bound of a circle of unknown radius seen over an arc φ,
    ``26.8 σ / (√n φ²)`` capped at the full-circle value (bounds of a uniform arc), with n the
    number of independent looks at the skin, not of frames.
    """

    chain: Chain
    _reference: dict[str, np.ndarray] = field(default_factory=dict)
    _low: dict[str, np.ndarray] = field(default_factory=dict)
    _high: dict[str, np.ndarray] = field(default_factory=dict)

    def look(self, latest: Mapping[str, Quaternion]) -> None:
        """Take the newest orientation of each sensor."""
        for joint, proximal, distal in self._pairs(latest):
            q = rotation.multiply(rotation.conjugate(proximal), distal)
            reference = self._reference.setdefault(joint, q)
            turned = rotation.log(rotation.multiply(rotation.conjugate(reference), q))
            self._low[joint] = np.minimum(self._low.get(joint, turned), turned)
            self._high[joint] = np.maximum(self._high.get(joint, turned), turned)

    def arcs(self) -> dict[str, float]:
        """Return the largest arc each inner joint went through so far, rad."""
        return {
            joint: float(np.linalg.norm(self._high[joint] - self._low[joint]))
            for joint in self._reference
        }

    def predicted_center_errors(self, elapsed_s: float) -> dict[str, float | None]:
        """Return the expected RMS error of each inner joint centre, m; None while it is useless."""
        looks = max(1.0, elapsed_s / CORRELATION_S)
        return {joint: _predicted(arc, looks) for joint, arc in self.arcs().items()}

    def _pairs(
        self, latest: Mapping[str, Quaternion]
    ) -> list[tuple[str, np.ndarray, np.ndarray]]:
        pairs = []
        for joint, above, below in zip(
            self.chain.joints[1:-1], self.chain.sensors, self.chain.sensors[1:], strict=False
        ):
            a = next((latest[s] for s in above if s in latest), None)
            b = next((latest[s] for s in below if s in latest), None)
            if a is not None and b is not None:
                pairs.append((joint, np.asarray(a), np.asarray(b)))
        return pairs


def _predicted(arc: float, looks: float) -> float | None:
    if arc < math.radians(5):
        return None
    factor = max(26.8 / arc**2, 2.0)
    return SKIN_NOISE_M * factor / math.sqrt(looks)
