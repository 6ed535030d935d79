"""Conventions of the limb's chain: adjacent body parts, neighboring segments, signs of flexion.

The joint types of chain models (ball, hinge, coupled) are in ``kinematics/chains/_model.py``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.model import Chain


FLEXES_FORWARD = ("hip", "ankle", "elbow", "shoulder", "wrist")
"""Parts of the names of joints whose flexion is a positive rotation about x (distal end forward).

Knees and joints with other names flex with a negative rotation."""


def body_parts(chain: Chain) -> list[str | None]:
    """Return the body parts from proximal to distal: joint i lies between parts i and i + 1."""
    return [chain.proximal, *chain.segments, chain.distal]


def configured_length(chain: Chain, i: int) -> float | None:
    """Return the configured length of segment i, m; None if calibration estimates it."""
    return chain.lengths[i] if i < len(chain.lengths) else None


def flexion_sign(joint: str) -> float:
    """Return +1 if flexion moves the distal segment forward, -1 for knees and unknown names."""
    return 1.0 if any(word in joint.casefold() for word in FLEXES_FORWARD) else -1.0


def neighbor(chain: Chain, i: int) -> tuple[str, ...]:
    """Return the sensors of the next segment, or of the previous one for the last segment."""
    count = len(chain.segments)
    if count == 1:
        return ()
    return chain.sensors[i + 1 if i + 1 < count else i - 1]
