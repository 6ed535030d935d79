"""Effect of an unobserved heading error of the whole limb on the standard deviations of a state."""

from __future__ import annotations

from math import hypot, sqrt
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.model import JointState, SegmentState


def add_segment_heading_sd(
    segments: tuple[SegmentState, ...], sd: float
) -> tuple[SegmentState, ...]:
    """Return the segments with a common heading error of standard deviation `sd`, rad, added.

    The error is about one axis of three, and ``SegmentState.sd`` is per axis.
    """
    return tuple(
        segment if segment.sd is None else segment._replace(sd=hypot(segment.sd, sd / sqrt(3.0)))
        for segment in segments
    )


def add_joint_heading_sd(joints: tuple[JointState, ...], sd: float) -> tuple[JointState, ...]:
    r"""Return the joints with the same error added: positions turn about the first joint.

    .. math:: \sigma^2 \leftarrow \sigma^2 + \tfrac13 \sigma_h^2 (\Delta x^2 + \Delta y^2)

    Joint angles do not depend on a common heading and keep their standard deviations.
    """
    first = joints[0].position
    return tuple(
        joint
        if first is None or joint.position is None or joint.position_sd is None
        else joint._replace(
            position_sd=hypot(
                joint.position_sd,
                sd / sqrt(3.0) * hypot(joint.position[0] - first[0], joint.position[1] - first[1]),
            ),
        )
        for joint in joints
    )
