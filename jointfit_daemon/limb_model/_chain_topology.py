"""Order of the joints, segments and body parts of a limb, with or without branches.

Invariant: for a limb without branches, joint i lies between the segments i - 1 and i.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from jointfit_daemon.model import Chain


class InnerJoint(NamedTuple):
    """A joint between two segments with sensors."""

    number: int
    name: str
    proximal: int
    """Number of the proximal segment."""
    distal: int
    """Number of the distal segment."""


def proximal_segment(chain: Chain, joint: int) -> int | None:
    """Return the number of the segment proximal to a joint; None for the first joint."""
    if chain.parents:
        return chain.parents[joint]
    return joint - 1 if joint > 0 else None


def inner_joints(chain: Chain) -> list[InnerJoint]:
    """Return the joints between two segments; the proximal segment has the smaller number."""
    found = []
    for number in range(1, len(chain.segments)):
        proximal = proximal_segment(chain, number)
        if proximal is not None:
            found.append(InnerJoint(number, chain.joints[number], proximal, number))
    return found


def distal_joints(chain: Chain, segment: int) -> list[int]:
    """Return the numbers of the joints at the distal end of a segment."""
    return [j for j in range(len(chain.joints)) if proximal_segment(chain, j) == segment]


def branch_runs(chain: Chain) -> list[list[int]]:
    """Return the runs of joints that are above each other while the subject stands.

    The joints of a run are in the order from proximal to distal.

    A limb without branches is one run. In a branched limb, the first joint is a run, and each of
    the two distal joints of the first segment starts a run.
    """
    runs: list[list[int]] = []
    starts = [0]
    while starts:
        run = [starts.pop(0)]
        while run[-1] < len(chain.segments):
            following = distal_joints(chain, run[-1])
            if len(following) != 1:
                starts += following
                break
            run += following
        runs.append(run)
    return runs


def body_parts(chain: Chain) -> list[str | None]:
    """Return the proximal body part, all segments, and the body parts distal to the chain's ends.

    A body part that the rig does not name is None. `joint_parts` relates the body parts to the
    joints.
    """
    return [chain.proximal, *chain.segments, *(chain.distals or (chain.distal,))]


def joint_parts(chain: Chain) -> list[tuple[int, int]]:
    """Return the numbers, in `body_parts`, of the proximal and distal body part of each joint."""
    above = (proximal_segment(chain, joint) for joint in range(len(chain.joints)))
    return [(0 if part is None else part + 1, joint + 1) for joint, part in enumerate(above)]


def is_left(chain: Chain, joint: int) -> bool:
    """Return whether a joint is on the left, where adduction and rotation change sign."""
    return chain.left_joints[joint] if chain.left_joints else chain.left_side


def neighbor(chain: Chain, i: int) -> tuple[str, ...]:
    """Return the sensors of the neighboring segment that a model of segment i may use.

    The neighbor is the segment distal to segment i, or the segment of the first branch if two
    segments are distal. If no segment is distal, the neighbor is the proximal segment. A single
    segment has no neighbor, and the result is empty.
    """
    following = [joint for joint in distal_joints(chain, i) if joint < len(chain.segments)]
    if following:
        return chain.sensors[following[0]]
    previous = proximal_segment(chain, i)
    return () if previous is None else chain.sensors[previous]
