"""State of online learning: whether it is possible, and the reason and duration of an obstacle.

An obstacle that lasts for `REPORT_NS` is reported once, and its end is reported once. The absence
of the subject from the view of the cameras is not an obstacle.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.name_lists import list_names
from jointfit_daemon.pipeline.events import Notice, NoticeKind, NoticeLevel
from jointfit_daemon.pipeline.health import LearningHealth, LearningState
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Sequence

REPORT_NS = 60 * NS_PER_S
"""Duration after which an obstacle is reported, ns. Most occlusions are shorter."""
MOCAP_SILENT_NS = 2 * NS_PER_S
"""Time without frames after which the mocap system counts as switched off, ns."""
MAX_NAMES = 4
"""Largest number of markers that a text lists by name."""


class LearningMonitor:
    """Monitors the state of one frame collector.

    Parameters
    ----------
    off : str or None
        Reason why the configuration or calibration excludes online learning; None if it does not.
    """

    def __init__(self, off: str | None = None) -> None:
        self._off = off
        self._mocap_ns: int | None = None
        self._usable_ns: int | None = None
        """Instant of the last frame that was usable or showed no marker; before such a frame, the
        instant of the first frame."""
        self._obstacle: str | None = None
        self._in_view = False
        self._reported = False

    def add_usable(self, now_ns: int) -> None:
        """Add a frame that can be used for learning."""
        self._mocap_ns = self._usable_ns = now_ns
        self._obstacle, self._in_view = None, True

    def add_obstacle(self, now_ns: int, reason: str, *, in_view: bool = True) -> None:
        """Add a frame that cannot be used. `in_view` states whether any marker is visible."""
        self._mocap_ns, self._obstacle, self._in_view = now_ns, reason, in_view
        if self._usable_ns is None or not in_view:  # an absent subject is no obstacle
            self._usable_ns = now_ns

    def notices(self, now_ns: int) -> list[Notice]:
        """Return the notices that are due at `now_ns`. Each notice is returned once."""
        if self._usable_ns is None:
            return []
        if self._reported:
            if self._obstacle is not None:
                return []
            self._reported = False
            return [Notice(now_ns, NoticeKind.CALIBRATION, "online", "online learning resumed")]

        present = self._mocap_present(now_ns) and self._in_view
        if self._obstacle is None or now_ns - self._usable_ns < REPORT_NS or not present:
            return []
        self._reported = True
        stopped_s = (now_ns - self._usable_ns) // NS_PER_S
        text = f"online learning stopped for {stopped_s} s: {self._obstacle}"
        data = {"reason": self._obstacle, "stopped_s": stopped_s}
        return [Notice(now_ns, NoticeKind.CALIBRATION, "online", text, NoticeLevel.WARNING, data)]

    def _mocap_present(self, now_ns: int) -> bool:
        return self._mocap_ns is not None and now_ns - self._mocap_ns <= MOCAP_SILENT_NS

    def health(self, now_ns: int, kept: int) -> LearningHealth:
        """Return the state of learning. `kept` is the number of frames that wait for a refit."""
        if self._off is not None:
            return LearningHealth(LearningState.OFF, self._off, kept=kept)
        if not self._mocap_present(now_ns):
            return LearningHealth(LearningState.WAITING, "no live mocap frames", kept=kept)
        if not self._in_view:
            return LearningHealth(LearningState.WAITING, self._obstacle, kept=kept)
        if self._obstacle is None:
            return LearningHealth(LearningState.LEARNING, kept=kept)
        since_ns = self._usable_ns
        stopped_ns = None if since_ns is None else now_ns - since_ns
        return LearningHealth(LearningState.STOPPED, self._obstacle, stopped_ns, kept)


def not_visible(markers: Sequence[str]) -> str:
    """Return a text that lists the markers that are not visible."""
    return f"not visible to the cameras: {list_names(markers, MAX_NAMES)}"
