"""The calibration as the wearer lives it: align, static, functional, fitting, calibrated.

Law: a pure state machine. It records what the core hands it, asks the worker for fits, and tells
what it wants to be told; it never fits anything itself and never blocks acquisition.

    uncalibrated ─► align ─► aligned
         └────────► static ─► posed ─► functional ─► fitting ─► calibrated
                              any phase ─► aborted (with the reason)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from jointfit_daemon.calibration import PLATE
from jointfit_daemon.calibration.guidance import MovementGuide
from jointfit_daemon.limb_model import Calibration
from jointfit_daemon.pipeline.calibration_session._phase_recording import TEXTS, Phase
from jointfit_daemon.pipeline.calibration_session._trial_recorder import LONGEST_S
from jointfit_daemon.pipeline.events import (
    CalibrationProgress,
    CalibrationReady,
    CalibrationStatus,
    CancelJob,
    FitJob,
    Notice,
    Reply,
)
from jointfit_daemon.pipeline.online_learning import Learned

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.calibration import CalibrationSettings, CalibrationTrial, Fresh
    from jointfit_daemon.model import Chain, MocapFrame, Quaternion
    from jointfit_daemon.pipeline.events import CalibrationStored, JobFinished, Output, Request
    from jointfit_daemon.pipeline.sources import LagWatch

COLLECTING = tuple(TEXTS)


@dataclass(frozen=True, slots=True)
class _Fit:
    job: int
    kind: str
    static: CalibrationTrial | None
    """The pose to be remembered if the worker accepts it."""


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
    version : int or None
        Under which number the store has it.
    """

    def __init__(
        self,
        chain: Chain,
        settings: CalibrationSettings,
        *,
        mocap: bool,
        calibration: Calibration | None,
        version: int | None = None,
    ) -> None:
        self._chain, self._settings, self._mocap = chain, settings, mocap
        self.calibration = calibration
        self.version = version
        """Of the calibration in force; None while it is not stored."""
        self.lags: LagWatch | None = None
        """Knows the lags that are configured and those seen while running."""
        self._phase: Phase | None = None
        self._alignment: Mapping[str, Any] | None = None
        self._static: CalibrationTrial | None = None
        self._pose_s = settings.static_s  # how long a pose was asked for, not what rig.toml has
        self._jobs = 0
        self._fitting: _Fit | None = None
        self._force = False
        self.learned = Learned()

    def take_over(self, before: CalibrationSession, *, same_rig: bool) -> None:
        """Go on from the session before a reload: its worlds and pose, if they are still true."""
        self._jobs = before._jobs  # numbers are never used twice
        if same_rig:
            self._alignment, self._static = before._alignment, before._static
            self._pose_s = before._pose_s
            self.learned.paused = before.learned.paused

    @property
    def collecting(self) -> bool:
        """Whether measurements are wanted right now."""
        return self._phase is not None

    @property
    def may_learn(self) -> bool:
        """Whether nothing is calibrated or learned right now, and there is something to improve."""
        busy = self._phase is not None or self._fitting is not None
        known = self.calibration is not None and not self.learned.paused
        return known and not busy and self.learned.job is None

    @property
    def phase(self) -> str:
        """Return what goes on; between phases, whether a calibration is in force."""
        if self._phase is not None:
            return self._phase.name
        if self._fitting is not None:
            return "fitting"
        return "calibrated" if self.calibration is not None else "uncalibrated"

    # --- what arrives ------------------------------------------------------------------------

    def add_sample(self, sensor: str, t_ns: int, q_world_sensor: Quaternion) -> list[Output]:
        """Take one orientation; call only while ``collecting``."""
        if self._phase is not None and self._phase.add_sample(sensor, t_ns, q_world_sensor):
            text = f"{sensor} moved: the time of standing still begins anew"
            return [Notice(t_ns, "calibration", sensor, text)]
        return []

    def add_mocap(self, t_ns: int, frame: MocapFrame) -> None:
        """Take one camera frame; call only while ``collecting``."""
        if self._phase is not None:
            self._phase.add_mocap(t_ns, frame)

    def advance(self, now_ns: int) -> list[Output]:
        """End the phase when it has what it wants; tell progress at most five times a second."""
        phase = self._phase
        if phase is None or not phase.due(now_ns):
            return []
        done, text, data = phase.progress(now_ns)
        outputs: list[Output] = [
            CalibrationProgress(now_ns, phase.name, round(done, 3), text, data)
        ]
        if done >= 1.0:
            return outputs + self._collected(phase, now_ns)
        if phase.given_up(now_ns):
            outputs += self.abort(now_ns, f"no {phase.wanted_s:g} s of stillness: {text}")
        return outputs

    def restarted(self, t_ns: int, sensor: str) -> list[Output]:
        """Take it that a sensor was off: the heading of its world may be another from here on."""
        outputs: list[Output] = []
        if self._phase is not None and self._phase.name != "static":  # stillness begins anew anyway
            outputs += self.abort(t_ns, f"{sensor} restarted in the middle: repeat the phase")
        posed, self._static = self._static is not None, None
        if posed or self._alignment is not None or self.calibration is not None:
            text = (
                f"{sensor} restarted: unless it finds north by itself its heading is another now; "
                "repeat the static pose, and the align phase before it if there was one"
            )
            outputs.append(Notice(t_ns, "calibration", sensor, text, "warning"))
        return outputs

    # --- requests ----------------------------------------------------------------------------

    def request(self, request: Request) -> list[Output]:
        """Begin or end a phase; the reply says ``accepted``, the rest is told as it happens."""
        wanted = str(request.arguments.get("phase", ""))
        if wanted == "unlearn":
            return self._unlearn(request)
        if wanted == "abort":
            outputs = self.abort(request.t_ns, "asked to")
            data = {"phase": self.phase}
            return [*outputs, Reply(request.command, request.transaction, "ok", data)]
        wanted_s = _seconds(request.arguments.get("seconds"))
        refusal = self._refusal(wanted)
        if refusal is None and wanted_s is not None and not 0.0 < wanted_s <= LONGEST_S:
            refusal = ("seconds", f"expected a number above 0 and up to {LONGEST_S}")
        if refusal is not None:
            key, message = refusal
            error = {"key": key, "message": message}
            return [Reply(request.command, request.transaction, "error", {}, error)]
        self._force = request.arguments.get("force") is True
        return [
            Reply(request.command, request.transaction, "accepted", {"phase": wanted}),
            *self._begin(request.t_ns, wanted, wanted_s or self._default_s(wanted)),
        ]

    def _unlearn(self, request: Request) -> list[Output]:
        """Go back to the models before online learning, and learn nothing until a new movement."""
        now = self.calibration
        before = None if now is None else self.learned.taken_back(now)
        if before is None or self._fitting is not None:
            error = {"key": "phase", "message": "nothing was learned since the daemon started"}
            return [Reply(request.command, request.transaction, "error", {}, error)]
        self.calibration, self.version = before, None
        text = "what was learned while running is taken back; nothing more is, until calibrated"
        return [
            Reply(request.command, request.transaction, "ok", {"phase": self.phase}),
            CalibrationReady(before),
            self._tell(request.t_ns, self.phase, text),
        ]

    def learn(self, fresh: Fresh) -> list[Output]:
        """Have the models fitted to what the cameras saw; call only while ``may_learn``."""
        if self.calibration is None:
            return []
        self._jobs += 1
        job = self._jobs, self.calibration, self._chain, self._settings, fresh
        return [self.learned.ask(*job)]

    def _learn(self, event: JobFinished, before: Calibration) -> list[Output]:
        found, notice = self.learned.finished(event, before, self.version)
        if found is None:
            return [notice]
        self.calibration, self.version = found, None
        told = self._tell(event.t_ns, self.phase, "models learned while running are in force")
        return [notice, CalibrationReady(found), told]

    def _refusal(self, wanted: str) -> tuple[str, str] | None:
        if wanted not in COLLECTING:
            return "phase", f"expected one of {', '.join(COLLECTING)}, abort; got {wanted!r}"
        if self.phase in (*COLLECTING, "fitting"):
            return "phase", (
                f"the phase {self.phase!r} is running: wait until it ends, or abort it with"
                ' `jointfit calibrate RIG.toml --abort` (over MQTT: {"phase":"abort"})'
            )
        if wanted in ("align", "functional") and not self._mocap:
            return "phase", f"{wanted!r} needs an optical system: add [mocap] to rig.toml"
        unready = self._unmarked(wanted) or (self._unposed() if wanted == "functional" else None)
        return None if unready is None else ("phase", unready)

    def _unposed(self) -> str | None:
        """Return what a movement lacks of a static pose."""
        if self._static is None:
            return "a static pose comes first: send static, stand still, then functional"
        if self._static.optical is None:
            return "the cameras saw nothing of the static pose: repeat it in their view"
        return None

    def _unmarked(self, wanted: str) -> str | None:
        """Return what the cameras could not recognise in a phase, and how to name it."""
        settings = self._settings
        if wanted == "align" and settings.plate is None and PLATE not in settings.markers:
            return (
                "'align' needs the plate that carries the sensors: name its rigid body in rig.toml "
                '([mocap] plate = "Plate") or its markers (markers.plate = [...])'
            )
        named = {*settings.markers, *settings.rigid_bodies}
        bare = [segment for segment in self._chain.segments if segment not in named]
        if wanted == "functional" and bare:
            return (
                f"'functional' needs markers on {', '.join(bare)}: name three or more in rig.toml "
                f"([mocap] markers.{bare[0]} = [...]) or a rigid body (rigid_body.{bare[0]} = "
                '"..."), then repeat the static pose'
            )
        return None

    def _default_s(self, wanted: str) -> float:
        settings = self._settings
        return {
            "align": settings.align_s,
            "static": settings.static_s,
            "functional": settings.functional_s,
        }[wanted]

    def _begin(self, t_ns: int, name: str, wanted_s: float) -> list[Output]:
        guide, settings = None, self._settings
        if name == "functional":
            guide = MovementGuide(self._chain, settings, self._static)
        wanted_s = min(wanted_s, LONGEST_S)
        least_s = settings.functional_min_s
        self._phase = Phase(name, self._chain, t_ns, wanted_s, guide=guide, least_s=least_s)
        most = "at most " if guide is not None else ""
        return [self._tell(t_ns, name, f"{TEXTS[name]}, {most}{wanted_s:g} s")]

    # --- phases end --------------------------------------------------------------------------

    def _collected(self, phase: Phase, now_ns: int) -> list[Output]:
        self._phase = None
        trial, settings = phase.trial(now_ns), self._settings
        payload: dict[str, object] = {"chain": self._chain}
        if phase.name == "align":
            payload["trial"] = trial
        else:
            stored = None if self.calibration is None else self.calibration.to_dict()
            payload |= {"alignment": self._alignment, "previous": stored, phase.name: trial}
        if phase.name == "static":
            self._pose_s = phase.wanted_s
        elif phase.name == "functional":
            payload["static"] = self._static
        payload["settings"] = replace(settings, static_s=self._pose_s)
        if self.lags is not None:
            payload |= {"lag_ns": self.lags.known_ns(), "tracked": self.lags.tracked()}
        self._jobs += 1
        self.learned.job = None  # one worker: it leaves what it learns for this
        self._fitting = _Fit(self._jobs, phase.name, trial if phase.name == "static" else None)
        outputs: list[Output] = []
        if phase.overflowed:
            text = f"{phase.overflowed} measurements found no room: ask for a shorter phase"
            outputs.append(Notice(now_ns, "calibration", phase.name, text, "warning"))
        outputs += _notes(now_ns, phase.name, phase.missing)
        said = "; ".join((f"fitting the {phase.name} trial", *phase.missing))
        return [
            *outputs,
            self._tell(now_ns, "fitting", said),
            FitJob(self._jobs, phase.name, payload),
        ]

    def job_finished(self, event: JobFinished) -> list[Output]:
        """Take what the worker made of the last phase. Results of cancelled jobs are ignored."""
        fit = self._fitting
        if event.job == self.learned.job and self.calibration is not None:
            return self._learn(event, self.calibration)
        if fit is None or event.job != fit.job:
            return []
        self._fitting = None
        result = event.result or {}
        failure = event.error or result.get("refused") or (None if result else "no result")
        if fit.kind == "static":
            self._static = fit.static if failure is None else None
        if failure is not None:
            return [self._tell(event.t_ns, "aborted", f"{fit.kind}: {failure}")]
        return self._finished(event.t_ns, fit.kind, dict(result))

    def _finished(self, t_ns: int, kind: str, result: dict[str, Any]) -> list[Output]:
        quality = result.get("quality", {})
        if kind == "align":
            self._alignment = result["alignment"]
            said = self._tell(t_ns, "aligned", "worlds aligned", {"alignment": quality})
            return [*_notes(t_ns, kind, result["alignment"].get("notes", ())), said]
        if kind == "static":
            quality = {"static": quality}
        if "calibration" not in result:
            return [self._tell(t_ns, "posed", "static pose taken", quality)]
        keep = result.get("worse")
        if keep is not None and not self._force:
            text = f"the stored calibration stays, the new one is worse: {keep}; force overrides"
            return [replace(self._tell(t_ns, self.phase, text), kept=str(keep), refused=quality)]
        self.calibration, self.version = Calibration.from_dict(result["calibration"]), None
        if kind == "functional":
            self.learned = Learned()
        phase = "posed" if kind == "static" else "calibrated"
        text = "static pose taken: sensors re-seated" if kind == "static" else "calibrated"
        return [
            *(_notes(t_ns, kind, self.calibration.notes) if kind == "functional" else ()),
            *_notes(t_ns, kind, result.get("notes", ()), "info"),
            CalibrationReady(self.calibration),
            self._tell(t_ns, phase, text, quality),
        ]

    def stored(self, event: CalibrationStored) -> list[Output]:
        """Take the number of the calibration in force; what goes on meanwhile goes on."""
        self.version = event.version
        return [self.status(event.t_ns, f"stored as version {event.version}")]

    def status(self, t_ns: int, text: str) -> CalibrationStatus:
        """Return what is to be told of the session as it stands."""
        return self._tell(t_ns, self.phase, text)

    def abort(self, t_ns: int, why: str) -> list[Output]:
        """End whatever runs."""
        if self._phase is None and self._fitting is None:
            return []
        outputs: list[Output] = []
        if self._fitting is not None:
            outputs.append(CancelJob(self._fitting.job))
        self._phase = self._fitting = None
        return [*outputs, self._tell(t_ns, "aborted", why)]

    def _tell(
        self, t_ns: int, phase: str, text: str, quality: Mapping[str, object] | None = None
    ) -> CalibrationStatus:
        """Return a status with the given figures, else with those of the calibration in force."""
        if quality is None:
            quality = {} if self.calibration is None else self.calibration.quality
        return CalibrationStatus(t_ns, phase, text, self.version, quality)


def _seconds(value: object) -> float | None:
    """Return a number of seconds as it was asked for; NaN for what is none."""
    if value is None:
        return None
    usable = isinstance(value, int | float) and not isinstance(value, bool)
    return float(str(value)) if usable else math.nan


def _notes(
    t_ns: int, kind: str, notes: Sequence[str], level: Literal["info", "warning"] = "warning"
) -> list[Output]:
    """Return what the wearer should know besides the figures."""
    return [Notice(t_ns, "calibration", kind, note, level) for note in notes]
