"""Effect of an unobserved heading error of the whole limb on the standard deviations of a state."""

from __future__ import annotations

from math import hypot, sqrt
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.model import JointState, SegmentState


def add_heading_sd(
    segments: tuple[SegmentState, ...], joints: tuple[JointState, ...], sd: float
) -> tuple[tuple[SegmentState, ...], tuple[JointState, ...]]:
    r"""Return segments and joints with a common heading error of standard deviation `sd`, rad.

    The heading error is a rotation about only one of three axes. Its contribution to the standard
    deviation per axis of an orientation is therefore `sd` / √3. The error rotates all positions
    about the first joint:

    .. math:: \sigma^2 \leftarrow \sigma^2 + \tfrac13 \sigma_h^2 (\Delta x^2 + \Delta y^2)

    Joint angles do not depend on a common heading, so their standard deviations are unchanged.
    """
    sd /= sqrt(3.0)
    segments = tuple(
        segment if segment.sd is None else segment._replace(sd=hypot(segment.sd, sd))
        for segment in segments
    )

    moved = []
    first = joints[0].position
    for joint in joints:
        if first is not None and joint.position is not None and joint.position_sd is not None:
            distance = hypot(joint.position[0] - first[0], joint.position[1] - first[1])
            moved.append(joint._replace(position_sd=hypot(joint.position_sd, sd * distance)))
        else:
            moved.append(joint)
    return segments, tuple(moved)
