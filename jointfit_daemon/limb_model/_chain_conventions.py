"""Conventions of a chain: body parts beside joints, neighboring segments, signs of flexion."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.model import Chain


FLEXES_FORWARD = ("hip", "ankle", "elbow", "shoulder", "wrist")
"""Joints with positive flexion about x (distal end forward); knees and other names are negative."""


def body_parts(chain: Chain) -> list[str | None]:
    """Return the body parts beside the joints: joint i lies between parts i and i + 1."""
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
