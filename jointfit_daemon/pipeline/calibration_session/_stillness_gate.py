"""Whether all sensors of a rig have been still, and since when.

Law: one causal stillness monitor a sensor (algorithm in ``calibration.stillness``); the pose is
still only while every sensor says so. One that is silent says nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.calibration.registration import StillnessMonitor

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.model import Quaternion

_NS = 1_000_000_000
SILENT_NS = 500_000_000
"""A sensor unheard of for this long cannot vouch for stillness."""


class StillnessGate:
    """Fed with every sample of a static phase.

    Parameters
    ----------
    sensors : sequence of str
        All of them must be heard, and be still.
    """

    def __init__(self, sensors: Sequence[str]) -> None:
        self._monitors = {sensor: StillnessMonitor() for sensor in sensors}
        self._still = dict.fromkeys(sensors, False)
        self._heard_ns: dict[str, int] = {}
        self.still_since_ns: int | None = None
        """Since when all have been still; None while they are not."""

    def feed(self, sensor: str, t_ns: int, q_world_sensor: Quaternion) -> bool:
        """Take one orientation; return True when this one ended a stillness."""
        monitor = self._monitors.get(sensor)
        if monitor is None:
            return False
        self._heard_ns[sensor] = t_ns
        self._still[sensor] = monitor.feed(t_ns, q_world_sensor)
        before = self.still_since_ns
        if self._moving() or self.silent(t_ns):
            self.still_since_ns = None
        elif before is None:
            self.still_since_ns = t_ns
        return before is not None and self.still_since_ns is None

    def still_s(self, now_ns: int) -> float:
        """Return for how long all have been still, s; a silence ends the stillness."""
        if self.silent(now_ns):
            self.still_since_ns = None
        since_ns = self.still_since_ns
        return 0.0 if since_ns is None else max(0, now_ns - since_ns) / _NS

    def silent(self, now_ns: int) -> list[str]:
        """Return the sensors that are not heard."""
        heard = self._heard_ns
        return [s for s in self._monitors if s not in heard or now_ns - heard[s] > SILENT_NS]

    def text(self, now_ns: int) -> str:
        """Return what the wearer should know."""
        if silent := self.silent(now_ns):
            return f"no data from {', '.join(silent)}: switch on and stand still"
        moving = self._moving()
        return f"moving: {', '.join(moving)}" if moving else "still: hold the pose"

    def _moving(self) -> list[str]:
        return sorted(sensor for sensor, still in self._still.items() if not still)
