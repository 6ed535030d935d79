"""One phase of a calibration while it collects: what came, how far it is, what the wearer hears.

Law: records and watches. When a phase begins, ends or is given up is the session's to decide.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.calibration.guidance import first_of
from jointfit_daemon.pipeline.calibration_session._stillness_gate import SILENT_NS, StillnessGate
from jointfit_daemon.pipeline.calibration_session._trial_recorder import TrialRecorder

if TYPE_CHECKING:
    from jointfit_daemon.calibration import CalibrationTrial
    from jointfit_daemon.calibration.guidance import MovementGuide, MovementLook
    from jointfit_daemon.model import Chain, MocapFrame, Quaternion

_NS = 1_000_000_000
PROGRESS_NS = 200_000_000  # five a second: what a progress bar can show
STATIC_PATIENCE_S = 120.0
"""A pose that is not still within this time is given up, with the reason."""
CAMERAS = "the cameras"
TEXTS = {
    "align": "turn the plate with all sensors by hand, about several axes",
    "static": "stand still and upright, facing one way, joints straight",
    "functional": "move every joint through its range: walk, squat, circle",
}
_KEEP_TURNING = "keep turning the plate about several axes"


class Phase:
    """What one phase has collected.

    Parameters
    ----------
    name : {"align", "static", "functional"}
        Static ends after so long a stillness, align after so long a time, functional when its
        guide misses nothing any more, after so long a time at the latest.
    chain : Chain
        Whose sensors take part.
    began_ns : int
        Now.
    wanted_s : float
        Length, s.
    guide : MovementGuide, optional
        Of the functional phase.
    least_s : float
        What a guide may not end before, s.
    """

    def __init__(
        self,
        name: str,
        chain: Chain,
        began_ns: int,
        wanted_s: float,
        *,
        guide: MovementGuide | None = None,
        least_s: float = 0.0,
    ) -> None:
        self.name, self.wanted_s = name, wanted_s
        self._guide, self._least_s = guide, min(least_s, wanted_s)
        self._look: MovementLook | None = None
        self._began_ns = self._told_ns = began_ns
        self._recorder = TrialRecorder()
        sensors = [sensor for group in chain.sensors for sensor in group]
        self._gate = StillnessGate(sensors) if name == "static" else None
        self._latest: dict[str, Quaternion] = {}
        self._heard_ns = dict.fromkeys(sensors, began_ns)
        if name != "static":
            self._heard_ns[CAMERAS] = began_ns

    def add_sample(self, sensor: str, t_ns: int, q_world_sensor: Quaternion) -> bool:
        """Take one orientation; return True when it ended a stillness."""
        self._recorder.add_sample(sensor, t_ns, q_world_sensor)
        self._latest[sensor] = q_world_sensor
        self._heard_ns[sensor] = t_ns
        return self._gate is not None and self._gate.feed(sensor, t_ns, q_world_sensor)

    def add_mocap(self, t_ns: int, frame: MocapFrame) -> None:
        """Take one camera frame."""
        self._recorder.add_mocap(t_ns, frame)
        if self._guide is not None:
            self._guide.add_mocap(frame)
        if CAMERAS in self._heard_ns:
            self._heard_ns[CAMERAS] = t_ns

    def due(self, now_ns: int) -> bool:
        """Tell whether it is time to look at the progress again, and take it for looked at."""
        if now_ns < self._told_ns + PROGRESS_NS:
            return False
        self._told_ns = now_ns
        return True

    def progress(self, now_ns: int) -> tuple[float, str, dict[str, object]]:
        """Return how far it is, 0 to 1, what the wearer should know, and figures."""
        if self._gate is not None:
            still_s = self._gate.still_s(now_ns)
            text = self._gate.text(now_ns)
            return self._share(still_s), text, {"still_s": round(still_s, 2)}
        elapsed_s = (now_ns - self._began_ns) / _NS
        silent = [name for name, t in self._heard_ns.items() if now_ns - t > SILENT_NS]
        done, text = self._share(elapsed_s), _KEEP_TURNING
        data: dict[str, object] = {}
        if self._guide is not None:
            done, text, data = self._guided(self._guide, elapsed_s, silent)
        if silent:
            text = f"no data from {', '.join(silent)}; {text}"
        return done, text, data

    def _share(self, seconds: float) -> float:
        return min(1.0, max(0.0, seconds / self.wanted_s))

    def _guided(
        self, guide: MovementGuide, elapsed_s: float, silent: list[str]
    ) -> tuple[float, str, dict[str, object]]:
        """Return how far a movement is: the whole of it once nothing is missing."""
        alive = {name: q for name, q in self._latest.items() if name not in silent}
        look = self._look = guide.look(alive, elapsed_s)
        data: dict[str, object] = {
            "joints": look.joints,
            "parts": look.parts,
            "missing": list(look.missing),
        }
        if not look.ready or silent:
            return self._share(elapsed_s), first_of(look.missing) or "keep moving", data
        left_s = self._least_s - elapsed_s
        if left_s > 0.0:
            return self._share(elapsed_s), f"all joints known; keep moving, {left_s:.0f} s", data
        return 1.0, f"all joints known after {elapsed_s:.0f} s", data

    @property
    def missing(self) -> tuple[str, ...]:
        """What the wearer has not shown so far, each with its remedy."""
        return () if self._look is None else self._look.missing

    def given_up(self, now_ns: int) -> bool:
        """Tell whether a stillness has been waited for long enough."""
        patience_ns = round(STATIC_PATIENCE_S * _NS)
        return self._gate is not None and now_ns - self._began_ns > patience_ns

    @property
    def overflowed(self) -> int:
        """Measurements that found no room."""
        return self._recorder.overflowed

    def trial(self, now_ns: int) -> CalibrationTrial:
        """Return what was recorded; of a static phase only the stillness it ended with."""
        if self._gate is None:
            return self._recorder.trial()
        return self._recorder.trial(self._gate.still_since_ns, now_ns)
