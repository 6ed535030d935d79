"""Joint centres of a chain of segments and their trajectories, from one marker trial.

Each joint centre is estimated in the frames of the two adjacent segments, if their markers define a
frame. A segment at an end of the chain needs no frame. One marker on it suffices for planar
movement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain, pairwise
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.center_of_rotation import JointSide, JointTrajectory, joint_trajectory
from jointfit_daemon.limb_model import MAX_FIT_RMS_M, MIN_MARKERS
from jointfit_daemon.tools.center.trial import (
    LEAST_PLANAR,
    UnsuitableTrialError,
    answers,
    reduce,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.files.axes import Axis
    from jointfit_daemon.files.mocap import MarkerTrial
    from jointfit_daemon.tools.center.trial import WindowEstimate


_LEAST_SEGMENTS = 2
"""Smallest number of segments of a chain; a joint connects two segments."""


@dataclass(frozen=True, slots=True)
class ChainSide:
    """Joint centre in the frame of one of the two segments of the joint."""

    parent: Sequence[str]
    """Markers that define the frame."""
    answer: WindowEstimate
    rms: float
    """RMS residual of the rigid fit to the markers `parent`, m."""


@dataclass(frozen=True, slots=True)
class ChainJoint:
    """Joint between two neighbouring segments."""

    name: str
    sides: Sequence[ChainSide]
    trajectory: JointTrajectory
    """Positions of the joint in the axes of the trial file."""
    faults: Sequence[str]
    """Error messages for the segments that have enough markers but yielded no frame or centre."""

    @property
    def refused(self) -> bool:
        """Whether the estimates from all `sides` were refused."""
        return all(side.answer.estimate.refused is not None for side in self.sides)


def joint_names(count: int, names: Sequence[str]) -> list[str]:
    """Return the names of the joints of a chain; by default ``joint1``, ``joint2``, ...

    Raises
    ------
    UnsuitableTrialError
        The number of names does not match, or a name occurs twice.
    """
    if not names:
        return [f"joint{i}" for i in range(1, count + 1)]
    if len(names) != count:
        raise UnsuitableTrialError(
            f"--joints: {len(names)} names, expected {count}: one for each pair of neighbouring"
            " segments, from the first to the last"
        )
    if several := sorted({name for name in names if names.count(name) > 1}):
        raise UnsuitableTrialError(
            f"--joints: {', '.join(several)} named more than once: use each name once"
        )
    return list(names)


def chain_joints(
    trial: MarkerTrial,
    segments: Sequence[Sequence[str]],
    names: Sequence[str],
    *,
    plane: Axis | None,
    method: str,
    source: MarkerTrial | None = None,
) -> list[ChainJoint]:
    """Estimate all joint centres of a chain, and their positions in every frame of a trial.

    Parameters
    ----------
    trial : MarkerTrial
        Trial whose frames are reconstructed.
    segments : sequence of sequence of str
        Markers of each segment, from one end of the chain to the other.
    names : sequence of str
        Names of the joints, one fewer than segments.
    plane : {"x", "y", "z"} or None
        Axis of the file normal to the plane of movement; None for spatial movement.
    method : str
        Estimator of the centres.
    source : MarkerTrial, optional
        Trial from which the centres are estimated, with the same marker placement. The default is
        `trial`.

    Raises
    ------
    UnsuitableTrialError
        Too few markers, a marker named twice, or a joint of which neither segment has a frame.
    """
    least = MIN_MARKERS if plane is None else LEAST_PLANAR
    _check_segments(segments, names, least)
    wide = trial if source is None else source

    joints = []
    for name, (first, second) in zip(names, pairwise(segments), strict=True):
        sides, located, faults = [], [], []
        for parent, child in ((first, second), (second, first)):
            if len(parent) < least:
                continue
            try:
                moved = reduce(wide, parent, child, plane, "--segment")
                answer = _refuse_other_segment(next(answers(wide, moved, method, None)), child)
                here = moved
                if source is not None:
                    here = reduce(trial, parent, child, plane, "--segment")
            except UnsuitableTrialError as fault:
                faults.append(fault)
                continue
            sides.append(ChainSide(parent, answer, here.rms))
            located.append(
                JointSide(here.poses, here.basis, here.template, here.rms, answer.estimate)
            )
        if not sides:
            raise faults[0]
        found = joint_trajectory(located, len(trial.trajectories.t_s))
        in_file = replace(found, positions=trial.to_file(found.positions))
        joints.append(ChainJoint(name, sides, in_file, [str(fault) for fault in faults]))
    return joints


def _check_segments(segments: Sequence[Sequence[str]], names: Sequence[str], least: int) -> None:
    if len(segments) < _LEAST_SEGMENTS:
        raise UnsuitableTrialError(
            f"--segment: {len(segments)} segment, expected at least 2: give the option once for"
            " each segment, from one end of the chain to the other"
        )

    markers = list(chain.from_iterable(segments))
    if several := sorted({m for m in markers if markers.count(m) > 1}):
        raise UnsuitableTrialError(
            f"--segment: {', '.join(several)} named more than once: a marker belongs to one segment"
        )

    for name, (first, second) in zip(names, pairwise(segments), strict=True):
        if max(len(first), len(second)) < least:
            space = " (2 for a planar movement, with --plane)" if least == MIN_MARKERS else ""
            raise UnsuitableTrialError(
                f"--segment: {name} is between {', '.join(first) or 'no marker'} and"
                f" {', '.join(second) or 'no marker'}, and neither segment has the {least} markers"
                f" that define a frame{space}: add markers to one of the two; only the segments at"
                " the ends of a chain need fewer"
            )
    if empty := [k + 1 for k, segment in enumerate(segments) if not segment]:
        raise UnsuitableTrialError(
            f"--segment: number {empty[0]} has no markers, expected at least 1: name one"
        )


def _refuse_other_segment(answer: WindowEstimate, child: Sequence[str]) -> WindowEstimate:
    """Refuse a centre if the distance of the child's markers to the centre varies too much."""
    e = answer.estimate
    if not MAX_FIT_RMS_M < e.residual < inf:
        return answer
    why = (
        f"{', '.join(child)}: distance to the centre varies by {1000 * e.residual:.0f} mm RMS,"
        f" expected at most {1000 * MAX_FIT_RMS_M:g} mm: list markers of the neighbouring segment"
    )
    return replace(answer, estimate=replace(e, refused=why))


def longest_gap_s(joint: ChainJoint, rate_hz: float) -> float:
    """Return the duration of the longest run of frames without a position, s."""
    known = np.isfinite(joint.trajectory.positions).all(axis=1)
    ends = np.flatnonzero(np.concatenate(([True], known, [True])))
    return float(np.diff(ends).max() - 1) / rate_hz
