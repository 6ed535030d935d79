"""What a heading that nobody sees does to a limb's deviations. Law: pure; joints do not mind."""

from __future__ import annotations

from math import hypot, sqrt
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.model import JointState, SegmentState


def widened_segments(segments: tuple[SegmentState, ...], sd: float) -> tuple[SegmentState, ...]:
    """Return the segments with a shared heading error of standard deviation `sd`, rad.

    It is an error about one axis of three, and `SegmentState.sd` is per axis.
    """
    return tuple(
        one if one.sd is None else one._replace(sd=hypot(one.sd, sd / sqrt(3.0)))
        for one in segments
    )


def widened_joints(joints: tuple[JointState, ...], sd: float) -> tuple[JointState, ...]:
    r"""Return the joints likewise: positions turn about the vertical through the first joint.

    .. math:: \sigma^2 \leftarrow \sigma^2 + \tfrac13 \sigma_h^2 (\Delta x^2 + \Delta y^2)

    Angles between segments stay as sure as they were.
    """
    first = joints[0].position
    return tuple(
        one
        if first is None or one.position is None or one.position_sd is None
        else one._replace(
            position_sd=hypot(
                one.position_sd,
                sd / sqrt(3.0) * hypot(one.position[0] - first[0], one.position[1] - first[1]),
            ),
        )
        for one in joints
    )
