"""The calibration as the wearer lives it: align, static, functional, fitting, calibrated.

Law: a pure state machine. It records what the core hands it, asks the worker for fits, and tells
what it wants to be told; it never fits anything itself and never blocks acquisition.

    uncalibrated ─► align ─► aligned
         └────────► static ─► posed ─► functional ─► fitting ─► calibrated
                              any phase ─► aborted (with the reason)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jointfit_daemon.calibration.progress import MovementProgress
from jointfit_daemon.calibration.result import Calibration
from jointfit_daemon.pipeline.events import (
    CalibrationProgress,
    CalibrationReady,
    CalibrationStatus,
    CancelJob,
    FitJob,
    Notice,
    Reply,
)
from jointfit_daemon.pipeline.recorder import LONGEST_S, TrialRecorder
from jointfit_daemon.pipeline.stillness_gate import StillnessGate

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.calibration.trial import CalibrationSettings, CalibrationTrial
    from jointfit_daemon.model import Chain, MocapFrame, Quaternion
    from jointfit_daemon.pipeline.events import JobFinished, Output, Request

_NS = 1_000_000_000
PROGRESS_NS = 200_000_000  # five a second: what a progress bar can show
STATIC_PATIENCE_S = 120.0
"""A pose that is not still within this time is given up, with the reason."""

COLLECTING = ("align", "static", "functional")


@dataclass(slots=True)
class _Phase:
    name: str
    began_ns: int
    wanted_s: float
    recorder: TrialRecorder
    told_ns: int = 0


class CalibrationSession:
    """Runs one calibration after another for one rig.

    Parameters
    ----------
    chain : Chain
        What is calibrated.
    settings : CalibrationSettings
        Durations, markers and method of rig.toml.
    mocap : bool
        Whether the rig has an optical system; without it only a static calibration is possible.
    calibration : Calibration or None
        What is in force already.
    """

    def __init__(
        self,
        chain: Chain,
        settings: CalibrationSettings,
        *,
        mocap: bool,
        calibration: Calibration | None,
    ) -> None:
        self._chain, self._settings, self._mocap = chain, settings, mocap
        self.calibration = calibration
        self.version: int | None = None
        self._phase: _Phase | None = None
        self._alignment: Mapping[str, Any] | None = None
        self._static: CalibrationTrial | None = None
        self._gate: StillnessGate | None = None
        self._movement: MovementProgress | None = None
        self._latest: dict[str, Quaternion] = {}
        self._job = 0
        self._running: tuple[int, str] | None = None
        self._force = False

    @property
    def collecting(self) -> bool:
        """Whether measurements are wanted right now."""
        return self._phase is not None

    @property
    def phase(self) -> str:
        """Return the phase by the name that ``CalibrationStatus`` publishes."""
        if self._phase is not None:
            return self._phase.name
        if self._running is not None:
            return "fitting"
        return "calibrated" if self.calibration is not None else "uncalibrated"

    # --- what arrives ------------------------------------------------------------------------

    def add_sample(self, sensor: str, t_ns: int, q_world_sensor: Quaternion) -> list[Output]:
        """Take one orientation; call only while ``collecting``."""
        phase = self._phase
        if phase is None:
            return []
        phase.recorder.add_sample(sensor, t_ns, q_world_sensor)
        self._latest[sensor] = q_world_sensor
        if self._gate is not None and self._gate.feed(sensor, t_ns, q_world_sensor):
            return [Notice(t_ns, "calibration", sensor, f"{sensor} moved: standing still again")]
        return []

    def add_mocap(self, t_ns: int, frame: MocapFrame) -> None:
        """Take one camera frame; call only while ``collecting``."""
        if self._phase is not None:
            self._phase.recorder.add_mocap(t_ns, frame)

    def advance(self, now_ns: int) -> list[Output]:
        """End the phase when it has what it wants; tell progress at most five times a second."""
        phase = self._phase
        if phase is None or now_ns < phase.told_ns + PROGRESS_NS:
            return []
        phase.told_ns = now_ns
        done, text, data = self._progress(phase, now_ns)
        outputs: list[Output] = [
            CalibrationProgress(now_ns, phase.name, round(min(done, 1.0), 3), text, data)
        ]
        if done >= 1.0:
            outputs += self._collected(phase, now_ns)
        elif phase.name == "static" and now_ns - phase.began_ns > STATIC_PATIENCE_S * _NS:
            outputs += self._abort(now_ns, f"no {phase.wanted_s:g} s of stillness: {text}")
        return outputs

    def _progress(self, phase: _Phase, now_ns: int) -> tuple[float, str, dict[str, object]]:
        elapsed = (now_ns - phase.began_ns) / _NS
        if phase.name == "static" and self._gate is not None:
            still = self._gate.still_s(now_ns)
            return still / phase.wanted_s, self._gate.text(now_ns), {"still_s": round(still, 2)}
        if phase.name == "functional" and self._movement is not None:
            self._movement.look(self._latest)
            errors = self._movement.predicted_center_errors(elapsed)
            data: dict[str, object] = {
                "arc_deg": {
                    joint: round(math.degrees(arc), 1)
                    for joint, arc in self._movement.arcs().items()
                },
                "predicted_center_error_m": errors,
            }
            return elapsed / phase.wanted_s, "keep moving", data
        return elapsed / phase.wanted_s, "keep turning the plate about several axes", {}

    # --- requests ----------------------------------------------------------------------------

    def request(self, request: Request) -> list[Output]:
        """Begin or end a phase; the reply says ``accepted``, the rest is told as it happens."""
        wanted = str(request.arguments.get("phase", ""))
        if wanted == "abort":
            return [*self._abort(request.t_ns, "asked to"), _reply(request, phase=self.phase)]
        refusal = self._refusal(wanted)
        if refusal is not None:
            key, message = refusal
            error = {"key": key, "message": message}
            return [Reply(request.command, request.transaction, "error", {}, error)]
        self._force = bool(request.arguments.get("force", False))
        seconds = request.arguments.get("seconds")
        wanted_s = self._default_s(wanted) if seconds is None else float(str(seconds))
        return [
            Reply(request.command, request.transaction, "accepted", {"phase": wanted}),
            *self._begin(request.t_ns, wanted, wanted_s),
        ]

    def _refusal(self, wanted: str) -> tuple[str, str] | None:
        if wanted not in COLLECTING:
            return "phase", f"expected one of {', '.join(COLLECTING)}, abort; got {wanted!r}"
        if self.phase in (*COLLECTING, "fitting"):
            return "phase", f"the phase {self.phase!r} is running: wait for it or send abort"
        if wanted in ("align", "functional") and not self._mocap:
            return "phase", f"{wanted!r} needs an optical system: add [mocap] to rig.toml"
        if wanted == "functional" and self._static is None:
            return "phase", "a static pose comes first: send static, stand still, then functional"
        return None

    def _default_s(self, wanted: str) -> float:
        settings = self._settings
        return {
            "align": settings.align_s,
            "static": settings.static_s,
            "functional": settings.functional_s,
        }[wanted]

    def _begin(self, t_ns: int, name: str, wanted_s: float) -> list[Output]:
        self._phase = _Phase(name, t_ns, min(wanted_s, LONGEST_S), TrialRecorder(), t_ns)
        self._latest = {}
        sensors = [sensor for group in self._chain.sensors for sensor in group]
        self._gate = StillnessGate(sensors, t_ns) if name == "static" else None
        self._movement = MovementProgress(self._chain) if name == "functional" else None
        text = {
            "align": "turn the plate with all sensors by hand, about several axes",
            "static": "stand still and upright, facing one way, joints straight",
            "functional": "move every joint through its range: walk, squat, circle",
        }[name]
        return [CalibrationStatus(t_ns, name, f"{text}, {wanted_s:g} s", self.version)]

    # --- phases end --------------------------------------------------------------------------

    def _collected(self, phase: _Phase, now_ns: int) -> list[Output]:
        self._phase, gate, self._gate = None, self._gate, None
        payload: dict[str, object] = {"chain": self._chain, "settings": self._settings}
        if phase.name == "align":
            payload["trial"] = phase.recorder.trial()
            return self._fit(now_ns, "align", payload)
        stored = None if self.calibration is None else self.calibration.to_dict()
        payload |= {"alignment": self._alignment, "previous": stored}
        if phase.name == "static":
            start_ns = gate.still_since_ns if gate is not None else None
            payload["static"] = phase.recorder.trial(start_ns, now_ns)
            self._static = phase.recorder.trial(start_ns, now_ns)
            return self._fit(now_ns, "static", payload)
        payload |= {"static": self._static, "functional": phase.recorder.trial()}
        return self._fit(now_ns, "functional", payload)

    def _fit(self, now_ns: int, kind: str, payload: Mapping[str, object]) -> list[Output]:
        self._job += 1
        self._running = (self._job, kind)
        return [
            CalibrationStatus(now_ns, "fitting", f"fitting the {kind} trial", self.version),
            FitJob(self._job, kind, payload),
        ]

    def job_finished(self, event: JobFinished) -> list[Output]:
        """Take what the worker made of the last phase. Results of cancelled jobs are ignored."""
        if self._running is None or event.job != self._running[0]:
            return []
        kind, self._running = self._running[1], None
        if event.error is not None or event.result is None:
            return self._failed(event.t_ns, f"{kind}: {event.error or 'no result'}")
        if (refused := event.result.get("refused")) is not None:
            return self._failed(event.t_ns, f"{kind}: {refused}")
        return self._finished(event.t_ns, kind, dict(event.result))

    def _finished(self, t_ns: int, kind: str, result: dict[str, Any]) -> list[Output]:
        quality = result.get("quality", {})
        if kind == "align":
            self._alignment = result["alignment"]
            return [CalibrationStatus(t_ns, "aligned", "worlds aligned", self.version, quality)]
        if "calibration" not in result:
            return [CalibrationStatus(t_ns, "posed", "static pose taken", self.version, quality)]
        keep = result.get("worse")
        if keep is not None and not self._force:
            text = f"the stored calibration stays, the new one is worse: {keep}; force overrides"
            return [
                Notice(t_ns, "calibration", kind, text, "warning", {"quality": quality}),
                CalibrationStatus(t_ns, self.phase, text, self.version, quality),
            ]
        self.calibration = Calibration.from_dict(result["calibration"])
        phase = "posed" if kind == "static" else "calibrated"
        text = "static pose taken: sensors re-seated" if kind == "static" else "calibrated"
        return [
            CalibrationReady(self.calibration),
            CalibrationStatus(t_ns, phase, text, self.version, quality),
        ]

    def _failed(self, t_ns: int, text: str) -> list[Output]:
        if text.startswith("static"):
            self._static = None
        return [
            Notice(t_ns, "calibration", "fit", text, "warning"),
            CalibrationStatus(t_ns, "aborted", text, self.version),
        ]

    def _abort(self, t_ns: int, why: str) -> list[Output]:
        outputs: list[Output] = []
        if self._running is not None:
            outputs.append(CancelJob(self._running[0]))
        ended = self._phase is not None or self._running is not None
        self._phase = self._running = self._gate = self._movement = None
        if ended:
            outputs.append(CalibrationStatus(t_ns, "aborted", why, self.version))
        return outputs

    def abort(self, t_ns: int, why: str) -> list[Output]:
        """End whatever runs: a reload changed the rig under it."""
        return self._abort(t_ns, why)


def _reply(request: Request, **data: object) -> Reply:
    return Reply(request.command, request.transaction, "ok", data)
