"""Notices of lost, exchanged and displaced markers of a planar chain.

Invariant: a fault of labels or places neither begins nor ends while markers of its segment are
hidden.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_daemon.model import MarkerFlag
from jointfit_daemon.name_lists import join_words
from jointfit_daemon.pipeline.events import Notice, NoticeKind, NoticeLevel
from jointfit_daemon.pipeline.planar_chain._planar_segment import MissingPose
from jointfit_daemon.pipeline.planar_chain._reversal_detector import KEPT_NS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from jointfit_daemon.pipeline.events import Output
    from jointfit_daemon.pipeline.planar_chain._reversal_detector import PlanarPose

LOST_NS = 10_000_000_000
"""Time for which a marker must be hidden before a notice, ns. Occlusions of seconds are
frequent."""
BEGIN_NS = {MarkerFlag.EXCHANGED: 1_000_000_000, MarkerFlag.MISFIT: 10_000_000_000}
"""Time for which a fault must last before a notice, ns. After a short movement out of the plane, a
segment has no pose for seconds."""
END_NS = 2_000_000_000
"""Time for which a segment must have a pose before the end of its fault is reported, ns."""


@dataclass(slots=True)
class _SegmentFault:
    """Fault of the markers of a segment, current and reported."""

    flag: MarkerFlag | None = None
    """Fault in the last frame; None if the segment had a pose."""
    since_ns: int = 0
    """Instant since which `flag` has had its value."""
    markers: tuple[str, ...] = ()
    """Markers of the fault, or of the last fault."""
    reported: MarkerFlag | None = None
    """Fault in the last notice."""


class PlanarMarkerMonitor:
    """Reports lost markers, and segments with exchanged or displaced markers.

    Parameters
    ----------
    names : sequence of str
        Names of all markers.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._seen_ns: list[int] = []
        """Instant at which each marker was last visible, or at which the monitor began."""
        self._lost: set[str] = set()
        self._faults: dict[str, _SegmentFault] = {}

    def update(
        self, t_ns: int, seen: NDArray[np.bool_], poses: Mapping[str, PlanarPose | MissingPose]
    ) -> list[Output]:
        """Process one frame, and return the notices of faults that began or ended.

        Parameters
        ----------
        t_ns
            Instant of the frame.
        seen
            Which of the markers are visible, in the order of their names.
        poses
            Pose of every segment, or the reason why it has no pose; empty without a plane. In a
            wrong plane, the markers of a segment do not seem to move together.
        """
        notices = self._update_lost(t_ns, seen.tolist())
        if not poses:
            for fault in self._faults.values():
                fault.flag = fault.reported
        for segment, pose in poses.items():
            notices += self._update_segment(t_ns, segment, pose)
        return notices

    def _update_lost(self, t_ns: int, seen: list[bool]) -> list[Output]:
        self._seen_ns = self._seen_ns or [t_ns] * len(seen)
        notices: list[Output] = []
        for k, (name, here) in enumerate(zip(self._names, seen, strict=True)):
            hidden_s = (t_ns - self._seen_ns[k]) / 1e9
            data = {"hidden_s": hidden_s}
            if here:
                self._seen_ns[k] = t_ns
                if name in self._lost:
                    self._lost.remove(name)
                    text = f"{name}: visible again after {hidden_s:.0f} s"
                    notices.append(_notice(t_ns, name, None, text, data))
            elif t_ns - self._seen_ns[k] > LOST_NS and name not in self._lost and any(seen):
                self._lost.add(name)
                text = (
                    f"{name}: not visible for {hidden_s:.0f} s; joints that need it have no "
                    "position. Uncover it, fix it, or correct its name"
                )
                notices.append(_notice(t_ns, name, MarkerFlag.LOST, text, data))
        return notices

    def _update_segment(
        self, t_ns: int, segment: str, pose: PlanarPose | MissingPose
    ) -> list[Output]:
        now = self._faults.setdefault(segment, _SegmentFault())
        if isinstance(pose, MissingPose) and pose.renewed:
            self._faults[segment] = _SegmentFault()
            text = f"{pose.reason}. Move the joints of {segment}"
            return [_notice(t_ns, pose.markers[0], None, text, _data(segment, pose.markers))]

        flag = None
        if isinstance(pose, MissingPose):
            if pose.flag is None:  # hidden markers and undecided labels change nothing
                return []
            flag, now.markers = pose.flag, pose.markers
        if flag is not now.flag:
            now.flag, now.since_ns = flag, t_ns
        least_ns = END_NS if flag is None else BEGIN_NS[flag]
        if flag is now.reported or t_ns - now.since_ns < least_ns:
            return []
        name = segment if MarkerFlag.MISFIT in {flag, now.reported} else now.markers[0]
        now.reported = flag
        text = _text(segment, flag, now.markers)
        return [_notice(t_ns, name, flag, text, _data(segment, now.markers))]


def _text(segment: str, flag: MarkerFlag | None, markers: tuple[str, ...]) -> str:
    names = join_words(markers)
    if flag is MarkerFlag.EXCHANGED:
        return (
            f"{names} on {segment} look exchanged. Correct their labels; these markers are not "
            f"used until then. After {KEPT_NS / 1e9:.0f} s, the present labels are used"
        )
    if flag is MarkerFlag.MISFIT:
        return (
            f"{names} on {segment} do not move together. Check their labels, and that they are "
            f"fixed on {segment}; these markers are not used until then"
        )
    return f"{names}: at the expected place again, and in use"


def _data(segment: str, markers: tuple[str, ...]) -> dict[str, object]:
    return {"markers": list(markers), "segments": [segment]}


def _notice(
    t_ns: int, name: str, flag: MarkerFlag | None, text: str, data: Mapping[str, object]
) -> Notice:
    level = NoticeLevel.INFO if flag is None else NoticeLevel.WARNING
    state = "ok" if flag is None else flag.value
    return Notice(t_ns, NoticeKind.MARKER, name, text, level, {"state": state, **data})
