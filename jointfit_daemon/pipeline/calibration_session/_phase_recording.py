"""Recording of one calibration phase: measurements, progress and instructions for the subject.

The calibration session decides when a phase starts, ends or is aborted.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from jointfit_daemon.calibration.guidance import most_urgent
from jointfit_daemon.pipeline.calibration_session._stillness_gate import SILENT_NS, StillnessGate
from jointfit_daemon.pipeline.calibration_session._trial_recorder import TrialRecorder
from jointfit_daemon.pipeline.events import CalibrationPhase
from jointfit_daemon.units import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.calibration import CalibrationTrial
    from jointfit_daemon.calibration.guidance import MovementGuide, MovementStatus
    from jointfit_daemon.model import Chain, MocapFrame, Quaternion

PROGRESS_NS = 200_000_000
"""Interval between progress reports, ns. Five reports per second suffice for a progress bar."""
STATIC_TIMEOUT_S = 120.0
"""Time after which a static phase without stillness is aborted, s."""
MOCAP = "the mocap system"
INSTRUCTIONS = {
    CalibrationPhase.ALIGN: "turn the plate with all sensors by hand, about several axes",
    CalibrationPhase.STATIC: "stand still and upright, facing one way, joints straight",
    CalibrationPhase.FUNCTIONAL: "move every joint through its range: walk, squat, circle",
}


class PhaseRecording:
    """Records one phase and measures its progress.

    Parameters
    ----------
    phase : CalibrationPhase
        Phase to record. ``static`` ends after `wanted_s` of stillness, and ``align`` after
        `wanted_s`. ``functional`` ends when all conditions of the guide hold, but not before
        `min_s`, and after `wanted_s` at the latest.
    chain : Chain
        Limb whose sensors take part.
    start_ns : int
        Host time of the start.
    wanted_s : float
        Required duration of the phase, s; for ``functional``, the longest duration.
    guide : MovementGuide, optional
        Object that tracks which movements of a functional phase are complete, and instructs the
        subject.
    min_s : float
        Shortest duration of a functional phase, s.
    """

    def __init__(
        self,
        phase: CalibrationPhase,
        chain: Chain,
        start_ns: int,
        wanted_s: float,
        *,
        guide: MovementGuide | None = None,
        min_s: float = 0.0,
    ) -> None:
        self.phase, self.wanted_s = phase, wanted_s
        self._guide, self._min_s = guide, min(min_s, wanted_s)
        self._look: MovementStatus | None = None
        self._start_ns = self._progress_ns = start_ns
        self._recorder = TrialRecorder()

        sensors = [sensor for group in chain.sensors for sensor in group]
        self._gate = StillnessGate(sensors) if phase == CalibrationPhase.STATIC else None
        self._latest: dict[str, Quaternion] = {}
        self._last_ns = dict.fromkeys(sensors, start_ns)
        if phase != CalibrationPhase.STATIC:
            self._last_ns[MOCAP] = start_ns

    def add_sample(self, sensor: str, t_ns: int, q_world_sensor: Quaternion) -> bool:
        """Add one orientation; return whether it ended a period of stillness of all sensors."""
        self._recorder.add_sample(sensor, t_ns, q_world_sensor)
        self._latest[sensor] = q_world_sensor
        self._last_ns[sensor] = t_ns
        return self._gate is not None and self._gate.feed(sensor, t_ns, q_world_sensor)

    def add_mocap(self, t_ns: int, frame: MocapFrame) -> None:
        """Add one mocap frame."""
        self._recorder.add_mocap(t_ns, frame)
        if self._guide is not None:
            self._guide.add_mocap(frame)
        if MOCAP in self._last_ns:
            self._last_ns[MOCAP] = t_ns

    def progress_due(self, now_ns: int) -> bool:
        """Return whether a progress report is due; if so, start the next interval."""
        if now_ns < self._progress_ns + PROGRESS_NS:
            return False
        self._progress_ns = now_ns
        return True

    def progress(self, now_ns: int) -> tuple[float, str, dict[str, object]]:
        """Return the progress (0 to 1), the instruction for the subject, and further data."""
        if self._gate is not None:
            still_s = self._gate.still_s(now_ns)
            text = self._gate.text(now_ns)
            return self._share(still_s), text, {"still_s": round(still_s, 2)}

        elapsed_s = (now_ns - self._start_ns) / NS_PER_S
        silent = [name for name, t in self._last_ns.items() if now_ns - t > SILENT_NS]
        done, text = self._share(elapsed_s), "keep turning the plate about several axes"
        data: dict[str, object] = {}

        if self._guide is not None:
            done, text, data = self._guided_progress(self._guide, elapsed_s, silent)
        if silent:
            text = f"no data from {', '.join(silent)}; {text}"
        return done, text, data

    def _share(self, seconds: float) -> float:
        return min(1.0, max(0.0, seconds / self.wanted_s))

    def _guided_progress(
        self, guide: MovementGuide, elapsed_s: float, silent: list[str]
    ) -> tuple[float, str, dict[str, object]]:
        """Return the progress of a functional phase.

        The progress is 1 after the longest duration. It is 1 earlier if all conditions hold, no
        source is silent, and the shortest duration has passed.
        """
        latest = {name: q for name, q in self._latest.items() if name not in silent}
        look = self._look = guide.update(latest, elapsed_s)
        data: dict[str, object] = {
            "joints": look.joints,
            "parts": look.parts,
            "missing": list(look.missing),
        }

        if not look.ready or silent:
            return self._share(elapsed_s), most_urgent(look.missing) or "keep moving", data
        left_s = self._min_s - elapsed_s
        if left_s > 0.0:
            return self._share(elapsed_s), f"all joints known; keep moving, {left_s:.0f} s", data
        return 1.0, f"all joints known after {elapsed_s:.0f} s", data

    def label_problem(self, exchanged_labels: Sequence[str]) -> str | None:
        """Return the reason to reject a static phase with exchanged labels; None without reason."""
        if not exchanged_labels or self.phase != CalibrationPhase.STATIC:
            return None
        return (
            f"static: {'; '.join(exchanged_labels)}. Correct the labels and repeat the phase; if "
            "the labels are correct and the chain model is wrong, request the phase with force"
        )

    @property
    def missing(self) -> tuple[str, ...]:
        """Movements that the subject must still perform, each with its instruction."""
        return () if self._look is None else self._look.missing

    def timed_out(self, now_ns: int) -> bool:
        """Return whether a static phase has waited too long for stillness."""
        timeout_ns = round(STATIC_TIMEOUT_S * NS_PER_S)
        return self._gate is not None and now_ns - self._start_ns > timeout_ns

    @property
    def overflowed(self) -> int:
        """Number of measurements that were not recorded, because the recording was full."""
        return self._recorder.overflowed

    def trial(self, now_ns: int) -> CalibrationTrial:
        """Return the recording; for a static phase, only the still period at its end."""
        if self._gate is None:
            return self._recorder.trial()
        return self._recorder.trial(self._gate.still_since_ns, now_ns)


def requested_seconds(value: object) -> float | None:
    """Return a requested number of seconds; None if absent, NaN if it is not a number."""
    if value is None:
        return None
    usable = isinstance(value, int | float) and not isinstance(value, bool)
    return float(str(value)) if usable else math.nan
