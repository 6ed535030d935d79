"""Whether all sensors of a rig have been still, and since when.

Law: one causal stillness monitor a sensor (algorithm in ``calibration.stillness``); the pose is
still only while every sensor is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.calibration.stillness import StillnessMonitor

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.model import Quaternion

_NS = 1_000_000_000
LOST_NS = (
    500_000_000  # a sensor unheard of for this long cannot vouch for stillness; it is left out
)


class StillnessGate:
    """Fed with every sample of a static phase."""

    def __init__(self, sensors: Sequence[str], t_ns: int) -> None:
        self._monitors = {sensor: StillnessMonitor() for sensor in sensors}
        self._still: dict[str, bool] = {}
        self._heard_ns: dict[str, int] = {}
        self.still_since_ns: int | None = None
        self._began_ns = t_ns

    def feed(self, sensor: str, t_ns: int, q_world_sensor: Quaternion) -> bool:
        """Take one orientation; return True when this one ended a stillness."""
        monitor = self._monitors.get(sensor)
        if monitor is None:
            return False
        self._heard_ns[sensor] = t_ns
        self._still[sensor] = monitor.feed(t_ns, q_world_sensor)
        if self._moving(t_ns):
            ended, self.still_since_ns = self.still_since_ns is not None, None
            return ended
        if self.still_since_ns is None:
            self.still_since_ns = t_ns
        return False

    def still_s(self, now_ns: int) -> float:
        """Return for how long all have been still, s."""
        return 0.0 if self.still_since_ns is None else (now_ns - self.still_since_ns) / _NS

    def text(self, now_ns: int) -> str:
        """Return what the wearer should know."""
        moving = self._moving(now_ns)
        return f"moving: {', '.join(moving)}" if moving else "still: hold the pose"

    def _moving(self, now_ns: int) -> list[str]:
        heard = [s for s, t in self._heard_ns.items() if now_ns - t < LOST_NS]
        return sorted(s for s in heard if not self._still.get(s, False))
