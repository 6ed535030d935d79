"""State of every sensor of a limb (ok, lost or stuck), and reports of changes of the state.

Fusion excludes a lost or stuck sensor as soon as the fault is detected. The report is delayed by
`REPORT_DELAY_NS`, so that single lost samples and loose connectors do not cause many events.

Invariant: the cost per frame is O(1), and no two successive reports of a sensor have the same
state.
"""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003 - mypyc evaluates the types of fields
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, NamedTuple

from jointfit_daemon.fusion.faults._stuck import StuckSensorDetector

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.model import Chain, Quaternion

SensorState = Literal["absent", "ok", "lost", "stuck"]

REPORT_DELAY_NS: dict[SensorState, int] = {"lost": 200_000_000, "ok": 2_000_000_000}
"""Duration of a state after which the state is reported, ns; other states are reported immediately.
"""


class SensorReport(NamedTuple):
    """A change in the state of a sensor or segment, for recordings and MQTT."""

    id: str
    """Name of the sensor or segment."""
    state: str
    text: str
    level: Literal["info", "warning"]
    data: Mapping[str, object] = MappingProxyType({})


@dataclass(slots=True)
class _SensorStatus:
    segment: str
    partners: tuple[str, ...]
    state: SensorState = "absent"
    since_ns: int = 0
    """Host arrival time at which `state` began."""
    reported: SensorState = "absent"


class SensorMonitor:
    """Monitors the state of the sensors of one limb.

    Parameters
    ----------
    chain : Chain
        Sensors by segment.
    """

    def __init__(self, chain: Chain) -> None:
        self._sensors = {
            name: _SensorStatus(segment, tuple(other for other in group if other != name))
            for segment, group in zip(chain.segments, chain.sensors, strict=True)
            for name in group
        }
        self._items = tuple(self._sensors.items())
        self._stuck_detector = StuckSensorDetector(chain.sensors)
        self._unreported = False
        """Whether the state of any sensor differs from its reported state."""

    def update(
        self, t_ns: int, now_ns: int, orientations: Mapping[str, Quaternion]
    ) -> tuple[Mapping[str, Quaternion], Sequence[str]]:
        """Add one frame; return the orientations without stuck sensors, and the stuck sensors.

        Parameters
        ----------
        t_ns, now_ns : int
            Instant of the frame, and host time of its completion.
        orientations : mapping of str to Quaternion
            Orientation by sensor, each in its own world; must not be changed afterwards.
        """
        stuck = self._stuck_detector.update(t_ns, orientations)

        for name, sensor in self._items:
            state: SensorState = (
                "lost" if name not in orientations else "stuck" if name in stuck else "ok"
            )
            if state != sensor.state and not (state == "lost" and sensor.state == "absent"):
                sensor.state, sensor.since_ns, self._unreported = state, now_ns, True
                if sensor.reported == "absent":  # `pipeline` reports the start of streaming
                    sensor.reported = "ok"

        if not stuck:
            return orientations, ()
        return {name: q for name, q in orientations.items() if name not in stuck}, stuck

    def pop_reports(self, now_ns: int) -> list[SensorReport]:
        """Return the reports that are due at `now_ns`, each once."""
        if not self._unreported:
            return []
        reports = [
            self._report(name, sensor)
            for name, sensor in self._items
            if sensor.state != sensor.reported
            and now_ns - sensor.since_ns >= REPORT_DELAY_NS.get(sensor.state, 0)
        ]
        self._unreported = any(sensor.state != sensor.reported for _, sensor in self._items)
        return reports

    def state(self, name: str) -> SensorState:
        """Return the state of one sensor."""
        return self._sensors[name].state

    def _report(self, name: str, sensor: _SensorStatus) -> SensorReport:
        sensor.reported = sensor.state
        if sensor.state == "ok":
            return SensorReport(name, "ok", f"sensor recovered; used for {sensor.segment}", "info")

        fault = "no data" if sensor.state == "lost" else "stuck: orientation does not change"
        working = [other for other in sensor.partners if self._sensors[other].state == "ok"]
        rest = f"uses {', '.join(working)}" if working else "has no working sensor"
        return SensorReport(name, sensor.state, f"{fault}; {sensor.segment} {rest}", "warning")
