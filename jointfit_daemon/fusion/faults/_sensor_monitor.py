"""Which sensors are to be believed, and what to tell when that changes.

Law: pure, O(1) a frame. Fusion drops what is lost or stuck in the very frame in which that is
known; what is told waits a moment, so that a lost sample is no news and a loose plug no flood.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, NamedTuple

from jointfit_daemon.fusion.faults._stuck import FrozenWatch

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.model import Chain, Quaternion

State = Literal["absent", "ok", "lost", "stuck"]

LOST_NS = 200_000_000
"""Silence that is told as a loss."""
BACK_NS = 2_000_000_000
"""A sensor that was lost or stuck must do well so long before it is told to be back."""


class SensorNews(NamedTuple):
    """A change worth telling."""

    id: str
    """A sensor, or a segment."""
    state: str
    text: str
    level: Literal["info", "warning"]
    data: Mapping[str, object] = MappingProxyType({})


@dataclass(slots=True)
class _Sensor:
    segment: str
    partners: tuple[str, ...]
    state: State = "absent"
    since_ns: int = 0
    """Of `state`, host arrival time."""
    told: State = "absent"


class SensorWatch:
    """Follows the sensors of a limb from frame to frame.

    Parameters
    ----------
    chain : Chain
        Sensors by segment.
    """

    def __init__(self, chain: Chain) -> None:
        self._sensors = {
            name: _Sensor(segment, tuple(other for other in group if other != name))
            for segment, group in zip(chain.segments, chain.sensors, strict=True)
            for name in group
        }
        self._items = tuple(self._sensors.items())
        self._frozen = FrozenWatch(chain.sensors)
        self._untold = False
        """Whether any state is another than what was told."""

    def look(
        self, t_ns: int, now_ns: int, said: Mapping[str, Quaternion]
    ) -> tuple[Mapping[str, Quaternion], Sequence[str]]:
        """Take one frame; return what of it is to be believed, and who is stuck.

        Parameters
        ----------
        t_ns, now_ns : int
            Instant of the frame, and host time of its completion.
        said : mapping of str to Quaternion
            Orientation by sensor, each in its own world; the caller must not change it afterwards.
        """
        stuck = self._frozen.look(t_ns, said)
        for name, one in self._items:
            state: State = "lost" if name not in said else "stuck" if name in stuck else "ok"
            if state != one.state and not (state == "lost" and one.state == "absent"):
                one.state, one.since_ns, self._untold = state, now_ns, True
                if one.told == "absent":  # that it streams is told already
                    one.told = "ok"
        if not stuck:
            return said, ()
        return {name: q for name, q in said.items() if name not in stuck}, stuck

    def news(self, now_ns: int) -> list[SensorNews]:
        """Return what is worth telling at `now_ns`, each change once."""
        if not self._untold:
            return []
        told = [
            self._tell(name, one)
            for name, one in self._items
            if one.state != one.told and now_ns - one.since_ns >= _patience_ns(one)
        ]
        self._untold = any(one.state != one.told for _, one in self._items)
        return told

    def health(self, name: str) -> State:
        """Return the state of one sensor."""
        return self._sensors[name].state

    def _tell(self, name: str, one: _Sensor) -> SensorNews:
        one.told = one.state
        if one.state == "ok":
            return SensorNews(name, "ok", f"takes part in {one.segment} again", "info")
        left = [other for other in one.partners if self._sensors[other].state == "ok"]
        goes_on = f"goes on with {', '.join(left)}" if left else "is left without a sensor"
        what = "gives no data" if one.state == "lost" else "is stuck: it repeats itself"
        return SensorNews(name, one.state, f"{what}; {one.segment} {goes_on}", "warning")


def _patience_ns(one: _Sensor) -> int:
    if one.state == "lost":
        return LOST_NS
    return BACK_NS if one.state == "ok" else 0
