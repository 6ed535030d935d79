"""Detection that all sensors of a rig are still during a static pose.

Every sensor has a causal stillness monitor (`calibration.registration.StillnessMonitor`). The pose
is still while every sensor is still. A sensor without data does not count as still.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.calibration.registration import StillnessMonitor
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.model import Quaternion

SILENT_NS = 500_000_000
"""Time without data after which a sensor counts as silent, ns."""
REPORTED_NS = 500_000_000
"""Shortest period of stillness whose end is reported, ns. Without this limit, a slow movement would
cause many reports."""


class StillnessGate:
    """Monitors the stillness of a static phase.

    Parameters
    ----------
    sensors : sequence of str
        Sensors that must send data and be still.
    """

    def __init__(self, sensors: Sequence[str]) -> None:
        self._monitors = {sensor: StillnessMonitor() for sensor in sensors}
        self._still = dict.fromkeys(sensors, False)
        self._last_ns: dict[str, int] = {}
        self.still_since_ns: int | None = None
        """Instant since which all sensors have been still; None while they are not still."""

    def feed(self, sensor: str, t_ns: int, q_world_sensor: Quaternion) -> bool:
        """Add one orientation; return whether it ended a still period of `REPORTED_NS` or more."""
        monitor = self._monitors.get(sensor)
        if monitor is None:
            return False
        self._last_ns[sensor] = t_ns
        self._still[sensor] = monitor.feed(t_ns, q_world_sensor)

        before = self.still_since_ns
        if self._moving() or self.silent(t_ns):
            self.still_since_ns = None
        elif before is None:
            self.still_since_ns = t_ns
        ended = before is not None and self.still_since_ns is None
        return ended and t_ns - (before or 0) >= REPORTED_NS

    def still_s(self, now_ns: int) -> float:
        """Return for how long all sensors have been still, s; 0 if a sensor is silent."""
        if self.silent(now_ns):
            self.still_since_ns = None
        since_ns = self.still_since_ns
        return 0.0 if since_ns is None else max(0, now_ns - since_ns) / NS_PER_S

    def silent(self, now_ns: int) -> list[str]:
        """Return the sensors that send no data."""
        last = self._last_ns
        return [s for s in self._monitors if s not in last or now_ns - last[s] > SILENT_NS]

    def text(self, now_ns: int) -> str:
        """Return the instruction for the subject."""
        if silent := self.silent(now_ns):
            return f"no data from {', '.join(silent)}: switch on and stand still"
        moving = self._moving()
        return f"moving: {', '.join(moving)}" if moving else "still: hold the pose"

    def _moving(self) -> list[str]:
        return sorted(sensor for sensor, still in self._still.items() if not still)
