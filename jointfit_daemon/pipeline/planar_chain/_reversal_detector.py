"""Detection of a segment that is rotated by 180°, because the labels of its markers are exchanged.

Without a gap, exchanged labels rotate the segment by 180° between two frames. After a gap, the
rotation alone does not show an exchange. The measured and the reversed pose are then compared by
the joint centers: each marker of an adjacent body part has a known distance from the center.

Invariant: after a gap, a pose of two markers is not used before this comparison is decided, if the
segment has a joint center.
"""

from __future__ import annotations

from cmath import exp, phase
from dataclasses import dataclass
from enum import Enum
from math import isfinite, pi
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

GAP_NS = 200_000_000
"""Shortest time between two poses in which labels may be exchanged without a visible rotation,
ns."""
KEPT_NS = 60_000_000_000
"""Time after which exchanged or undecided labels are accepted, ns. After such a long time, the
earlier labels or the joint centers may be wrong instead."""
_EXCHANGE_RAD = 2.5
"""Rotation between two frames above which the labels must have been exchanged, rad."""
_LARGEST_M = 0.15
"""Largest error of a distance in the comparison, m, to limit the influence of displaced markers."""
_DECISIVE_M = 0.1
"""Difference between the summed errors of the two poses that decides the comparison, m. One frame
usually suffices. Soft-tissue artefact is smaller."""


class PlanarPose(NamedTuple):
    """Pose of a segment in the plane. A point z of the segment is at turn · z + origin."""

    turn: complex
    """Rotation as a complex number of absolute value 1."""
    origin: complex
    """Position of the segment's origin, m."""


class AdjacentMarker(NamedTuple):
    """Marker of an adjacent body part, which moves on a circle about the joint."""

    center: complex
    """Joint center in the coordinates of the segment, m."""
    radii: tuple[float, ...]
    """Known distances of the markers of this part from the joint center, m. The labels of this part
    may be exchanged, so any of them is possible."""
    point: complex
    """Position of the marker in the plane, m; NaN while it is hidden."""

    def error(self, pose: PlanarPose) -> float:
        """Return the error of the marker's distance from the joint center for a pose, m."""
        center = pose.turn * self.center + pose.origin
        distance = abs(self.point - center)
        return min(_LARGEST_M, *(abs(distance - radius) for radius in self.radii))


class Labels(Enum):
    """State of the labels of a segment in one frame."""

    CORRECT = "correct"
    EXCHANGED = "exchanged"
    UNDECIDED = "undecided"
    RENEWED = "renewed"
    """The labels are accepted, although they may contradict the labels of earlier frames."""


@dataclass(slots=True)
class ReversalDetector:
    """Detects exchanged labels of one segment."""

    state: Labels = Labels.CORRECT
    _angle: float | None = None
    """Rotation of the segment with correct labels in the last decided frame, rad."""
    _seen_ns: int = 0
    _unused_ns: int | None = None
    """Instant since which the labels have been exchanged or undecided."""
    _advantage: float = 0.0
    """Sum of the errors of the reversed pose minus the errors of the measured pose, m."""

    def update(
        self,
        t_ns: int,
        poses: tuple[PlanarPose, PlanarPose],
        adjacent: Callable[[], list[AdjacentMarker]],
        *,
        reversible: bool,
    ) -> Labels:
        """Return the state of the labels in a frame.

        Parameters
        ----------
        t_ns
            Instant of the frame.
        poses
            Measured pose, and pose of the segment if two labels are exchanged.
        adjacent
            Function that returns the markers of adjacent parts; none without a joint center.
        reversible
            Whether both poses fit the markers. More than two markers determine the pose.
        """
        gap = t_ns - self._seen_ns >= GAP_NS
        self._seen_ns = t_ns
        if self._angle is None:
            return self._decide(t_ns, poses, Labels.CORRECT)
        turned = abs(phase(poses[0].turn * exp(-1j * self._angle)))
        if gap and self.state is not Labels.UNDECIDED:
            self._advantage, self.state = 0.0, Labels.UNDECIDED
        if self.state is not Labels.UNDECIDED:
            exchanged = turned > _EXCHANGE_RAD
            return self._decide(t_ns, poses, Labels.EXCHANGED if exchanged else Labels.CORRECT)
        if not reversible:
            return self._decide(t_ns, poses, Labels.CORRECT)
        return self._decide(t_ns, poses, self._compare(turned, poses, adjacent()))

    def _compare(
        self, turned: float, poses: tuple[PlanarPose, PlanarPose], adjacent: list[AdjacentMarker]
    ) -> Labels:
        """Compare both poses with the joint centers; without centers, decide by the rotation."""
        if not adjacent:
            return Labels.CORRECT if turned < pi / 2 else Labels.RENEWED
        visible = [marker for marker in adjacent if isfinite(abs(marker.point))]
        self._advantage += sum(one.error(poses[1]) - one.error(poses[0]) for one in visible)
        if abs(self._advantage) >= _DECISIVE_M:
            return Labels.CORRECT if self._advantage > 0.0 else Labels.EXCHANGED
        return Labels.UNDECIDED

    def _decide(self, t_ns: int, poses: tuple[PlanarPose, PlanarPose], labels: Labels) -> Labels:
        if labels is Labels.CORRECT:
            self._angle, self._unused_ns = phase(poses[0].turn), None
        else:
            self._unused_ns = t_ns if self._unused_ns is None else self._unused_ns
            if labels is Labels.EXCHANGED:
                self._angle = phase(poses[1].turn)
            if t_ns - self._unused_ns >= KEPT_NS:
                labels = Labels.RENEWED
        self.state = labels
        return labels
