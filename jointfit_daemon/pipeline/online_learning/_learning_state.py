"""What keeps a limb from learning on while cameras see it, and since when.

Law: pure. A hindrance that lasts is told once, and its end; nobody in view of the cameras is none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.pipeline.events import Notice

if TYPE_CHECKING:
    from collections.abc import Sequence

_NS = 1_000_000_000
TOLD_NS = 60 * _NS
"""A hindrance is told after this; a movement out of view or a lost sensor is mostly shorter."""
AWAY_NS = 2 * _NS
"""Silence of the cameras after which they are not there."""
NAMED = 4
"""Markers that are named one by one."""


class LearningWatch:
    """Follows one learner.

    Parameters
    ----------
    off : str or None
        Why nothing will ever be learned as it stands; None: it may be.
    """

    def __init__(self, off: str | None = None) -> None:
        self._off = off
        self._heard_ns: int | None = None
        self._well_ns: int | None = None
        """When a frame was last good for learning, or when looking began."""
        self._why: str | None = None
        self._in_view = False
        self._told = False

    def well(self, now_ns: int) -> None:
        """Take it that a frame could be learned from."""
        self._heard_ns = self._well_ns = now_ns
        self._why, self._in_view = None, True

    def hindered(self, now_ns: int, why: str, *, in_view: bool = True) -> None:
        """Take it that a frame could not, and why; `in_view`: somebody is seen at all."""
        self._heard_ns, self._why, self._in_view = now_ns, why, in_view
        if self._well_ns is None or not in_view:  # who is away hinders nothing
            self._well_ns = now_ns

    def notices(self, now_ns: int) -> list[Notice]:
        """Return what is worth telling at `now_ns`, each change once."""
        if self._well_ns is None:
            return []
        if self._told:
            if self._why is not None:
                return []
            self._told = False
            return [Notice(now_ns, "calibration", "online", "learns again from what cameras see")]
        if self._why is None or now_ns - self._well_ns < TOLD_NS or self._away(now_ns):
            return []
        self._told = True
        stopped_s = (now_ns - self._well_ns) // _NS
        text = f"nothing has been learned for {stopped_s} s: {self._why}"
        data = {"reason": self._why, "stopped_s": stopped_s}
        return [Notice(now_ns, "calibration", "online", text, "warning", data)]

    def _away(self, now_ns: int) -> bool:
        return self._heard_ns is None or now_ns - self._heard_ns > AWAY_NS or not self._in_view

    def health(self, now_ns: int, kept: int) -> dict[str, object]:
        """Return the state of learning, JSON-able.

        Parameters
        ----------
        now_ns : int
            Host time.
        kept : int
            Frames that wait for a refit.
        """
        state, reason, since_ns = "learning", self._why, self._well_ns
        if self._off is not None:
            state, reason = "off", self._off
        elif self._heard_ns is None or now_ns - self._heard_ns > AWAY_NS:
            state, reason = "waiting", "no live frame of the cameras"
        elif not self._in_view:
            state = "waiting"
        elif self._why is not None:
            state = "stopped"
        stopped = state == "stopped" and since_ns is not None
        return {
            "state": state,
            "reason": reason,
            "stopped_s": round((now_ns - (since_ns or 0)) / _NS, 1) if stopped else None,
            "kept": kept,
        }


def hidden(markers: Sequence[str]) -> str:
    """Return in words which markers the cameras do not see."""
    named = ", ".join(markers[:NAMED])
    more = f" and {len(markers) - NAMED} more" if len(markers) > NAMED else ""
    return f"the cameras do not see {named}{more}"
