"""Conventions of a chain: body parts beside a joint, neighbouring segments, sign of flexion."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.model import Chain
if TYPE_CHECKING:
    from jointfit_daemon.model import Chain


FLEXES_FORWARD = ("hip", "ankle", "elbow", "shoulder", "wrist")
"""Joints whose flexion is positive about x (the distal part goes forward); others are knees."""


def body_parts(chain: Chain) -> list[str | None]:
    """Return the parts on either side of the joints: joint i lies between parts i and i + 1."""
    return [chain.proximal, *chain.segments, chain.distal]


def flexion_sign(joint: str) -> float:
    """Return +1 where flexion brings the distal part forward, -1 for knees and unknown names."""
    return 1.0 if any(word in joint.casefold() for word in FLEXES_FORWARD) else -1.0


def neighbor(chain: Chain, i: int) -> tuple[str, ...]:
    """Return the sensors of the segment that segment i looks at: the next, the last looks back."""
    count = len(chain.segments)
    if count == 1:
        return ()
    return chain.sensors[i + 1 if i + 1 < count else i - 1]
