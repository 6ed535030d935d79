"""Refined marker positions of a chain model, which are part of a calibration.

Invariant: positions are used only with the model in which they were refined. A model with other
joints, axes or nominal positions has another fingerprint.
"""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.kinematics.chains import ChainModel
    from jointfit_daemon.model import Vector

_DIGITS = 9
"""Decimal places of the numbers in a fingerprint. The resolution is a nanometre, so that rounding
has no effect.
"""


@dataclass(frozen=True, slots=True)
class RefinedChain:
    """Refined marker positions of one chain model."""

    model: str
    """Name of the chain model."""
    fingerprint: str
    """`chain_fingerprint` of the model before the refinement."""
    positions: Mapping[str, Vector]
    """Position of every refined marker in the axes of its segment, m."""

    def apply(self, model: ChainModel) -> ChainModel | None:
        """Return the model with the refined positions; None if the fingerprint differs."""
        if chain_fingerprint(model) != self.fingerprint:
            return None
        return model.with_markers([self.positions.get(m.name, m.position) for m in model.markers])


def chain_fingerprint(model: ChainModel) -> str:
    """Return the SHA-256, in hex, of segments, joints and nominal markers.

    Weights, locks and limits do not change the meaning of a position and are excluded.
    """
    joints = [
        (s.name, s.parent, s.joint.kind, *_round_values(
            (*s.joint.center_in_parent, *s.joint.center, *s.joint.axis, *s.joint.rest),
            *s.joint.path,
        ))
        for s in model.segments
    ]  # fmt: skip
    markers = [(m.name, m.segment, *_round_values(m.position)) for m in model.markers]
    return sha256(repr((joints, markers)).encode()).hexdigest()


def _round_values(*rows: tuple[float, ...]) -> list[float]:
    """Return all numbers, rounded, in one list, with 0 instead of -0."""
    return [float(value) for row in rows for value in np.round(row, _DIGITS) + 0.0]
