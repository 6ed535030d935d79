"""Conventions of joints and segments: angles, signs of flexion, configured lengths.

The joint types of chain models (ball, hinge, coupled) are in ``kinematics/chains/_model.py``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import AngleConvention

if TYPE_CHECKING:
    from jointfit_daemon.model import Chain


TRUNK_JOINTS = ("trunk", "spine", "lumb", "neck", "cervic")
"""Parts of the names of trunk joints. A trunk is listed from the top, so the proximal segment of
such a joint is the upper one."""
SHOULDER_JOINTS = ("shoulder", "glenohumeral", "humerothoracic", "thoracohumeral")
"""Parts of the names of joints with the angles plane of elevation, elevation and rotation."""
FLEXES_FORWARD = ("hip", "ankle", "elbow", "wrist", *SHOULDER_JOINTS, *TRUNK_JOINTS)
"""Parts of the names of joints whose flexion is a positive rotation about x, which moves the distal
end forward. The flexion of knees and of joints with other names is a negative rotation.
"""


def angle_convention(chain: Chain, i: int) -> AngleConvention:
    """Return the angle convention of joint i, from the configuration or the joint name."""
    configured = chain.conventions[i] if i < len(chain.conventions) else None
    if configured is not None:
        return configured
    name = chain.joints[i].casefold()
    if any(word in name for word in SHOULDER_JOINTS):
        return AngleConvention.ELEVATION
    if any(word in name for word in TRUNK_JOINTS):
        return AngleConvention.TRUNK
    return AngleConvention.FLEXION


def configured_length(chain: Chain, i: int) -> float | None:
    """Return the configured length of segment i, m; None if calibration estimates it."""
    return chain.lengths[i] if i < len(chain.lengths) else None


def flexion_sign(joint: str) -> float:
    """Return +1 if flexion moves the distal segment forward, -1 for knees and unknown names."""
    return 1.0 if any(word in joint.casefold() for word in FLEXES_FORWARD) else -1.0
