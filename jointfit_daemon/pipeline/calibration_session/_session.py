"""Calibration session: the phases align, static and functional, and the fits that follow them.

The session records the measurements of a phase, requests a fit from the worker process, and
publishes status and progress. The module
:mod:`jointfit_daemon.pipeline.calibration_session._state_machine` contains the table of phases and
transitions.

Invariant: the session never computes a fit itself, so it never blocks acquisition.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from jointfit_daemon.calibration import PLATE, AlignJob, FunctionalJob, RefitJob, StaticJob
from jointfit_daemon.calibration.guidance import MovementGuide
from jointfit_daemon.pipeline.calibration_session._alignment_text import alignment_text
from jointfit_daemon.pipeline.calibration_session._phase_recording import (
    INSTRUCTIONS,
    STATIC_TIMEOUT_S,
    PhaseRecording,
    requested_seconds,
)
from jointfit_daemon.pipeline.calibration_session._state_machine import (
    COLLECTING,
    RESTING,
    START,
    TRANSITIONS,
    SessionEvent,
)
from jointfit_daemon.pipeline.calibration_session._trial_recorder import MAX_PHASE_S
from jointfit_daemon.pipeline.events import (
    CalibrationPhase,
    CalibrationProgress,
    CalibrationReady,
    CalibrationStatus,
    CancelJob,
    FitJob,
    Notice,
    NoticeKind,
    NoticeLevel,
)
from jointfit_daemon.pipeline.online_learning import OnlineRefits

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.calibration import (
        CalibrationJob,
        CalibrationSettings,
        CalibrationTrial,
        FitResult,
        OnlineFrames,
    )
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chain, MocapFrame, Quaternion
    from jointfit_daemon.pipeline.events import (
        CalibrationSelected,
        CalibrationStored,
        JobFinished,
        JobProgress,
        Output,
        Request,
    )
    from jointfit_daemon.pipeline.sources import LagMonitor


PLANAR = (
    "a planar rig has no sensors and needs no calibration: its joints are on the topic "
    "optical/sticks"
)
"""Reason why a planar rig starts no calibration phase."""


class CalibrationSession:
    """Runs the calibrations of one rig, one after another.

    Parameters
    ----------
    chain : Chain
        The limb to calibrate.
    settings : CalibrationSettings
        Durations, markers and method from rig.toml.
    mocap : bool
        Whether the rig has a mocap source. Without mocap, only a static calibration is possible.
    calibration : Calibration or None
        The current calibration; None if there is none.
    version : int or None
        Version of `calibration` in the store; None if it is not stored.
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
        """Version of the current calibration; None while it is not stored."""
        self._created_utc = "" if calibration is None else calibration.created_utc
        """Date of the calibration whose number is `version`."""
        self.lags: LagMonitor | None = None
        """Lags from the configuration, and lags estimated during operation."""
        self._state = self._resting_phase
        self._recording: PhaseRecording | None = None
        self._fit: FitJob | None = None
        self._alignment: Mapping[str, Any] | None = None
        self._static: CalibrationTrial | None = None
        self._static_s = settings.static_s
        """Requested length of the static pose, s, which may differ from rig.toml."""
        self._jobs = 0
        self._force = False
        self.refits = OnlineRefits()

    def resume(self, before: CalibrationSession, *, same_rig: bool) -> None:
        """Continue the session of `before`; keep its alignment and static pose if `same_rig`."""
        self._jobs = before._jobs  # job numbers are never reused
        if same_rig:
            self._alignment, self._static = before._alignment, before._static
            self._static_s = before._static_s
            self.refits.paused = before.refits.paused

    @property
    def collecting(self) -> bool:
        """Whether a phase is recording measurements."""
        return self._recording is not None

    @property
    def may_learn(self) -> bool:
        """Whether a refit may start.

        It may start if the limb is calibrated, learning is not paused, and no phase or fit is
        running.
        """
        available = self.calibration is not None and not self.refits.paused
        return available and self._state in RESTING and self.refits.job is None

    @property
    def phase(self) -> CalibrationPhase:
        """The running phase; if none is running, ``calibrated`` or ``uncalibrated``."""
        return self._resting_phase if self._state in RESTING else self._state

    @property
    def _resting_phase(self) -> CalibrationPhase:
        if self.calibration is None:
            return CalibrationPhase.UNCALIBRATED
        return CalibrationPhase.CALIBRATED

    @property
    def _done(self) -> tuple[CalibrationPhase, ...]:
        """Recorded phases whose results the functional phase uses, except the running phase."""
        running = None if self._fit is None else self._fit.work.name
        if self._recording is not None:
            running = self._recording.phase
        results = {
            CalibrationPhase.ALIGN: self._alignment,
            CalibrationPhase.STATIC: self._static,
        }
        return tuple(
            phase for phase, result in results.items() if result is not None and phase != running
        )

    # --- measurements ------------------------------------------------------------------------

    def add_sample(self, sensor: str, t_ns: int, q_world_sensor: Quaternion) -> list[Output]:
        """Add one orientation. Call it only while ``collecting``."""
        recording = self._recording
        if recording is not None and recording.add_sample(sensor, t_ns, q_world_sensor):
            text = "moved: stillness is timed from the start again"
            return [Notice(t_ns, NoticeKind.CALIBRATION, sensor, text)]
        return []

    def add_mocap(self, t_ns: int, frame: MocapFrame) -> None:
        """Add one mocap frame. Call it only while ``collecting``."""
        if self._recording is not None:
            self._recording.add_mocap(t_ns, frame)

    def advance(self, now_ns: int, exchanged_labels: Sequence[str] = ()) -> list[Output]:
        """Publish progress at most five times a second; end the phase when it is complete.

        A complete static phase is rejected while labels of markers are exchanged, unless the
        request has ``force``. Each of `exchanged_labels` is a sentence that names them.
        """
        recording = self._recording
        if recording is None or not recording.progress_due(now_ns):
            return []
        done, text, data = recording.progress(now_ns)

        outputs: list[Output] = [
            CalibrationProgress(now_ns, recording.phase, round(done, 3), text, data)
        ]
        if done >= 1.0:
            problem = None if self._force else recording.label_problem(exchanged_labels)
            if problem is not None:
                self._static = None
                return outputs + self.abort(now_ns, problem)
            return outputs + self._start_fit(recording, now_ns)
        if recording.timed_out(now_ns):
            reason = (
                f"no {recording.wanted_s:g} s of stillness within {STATIC_TIMEOUT_S:g} s: {text}"
            )
            outputs += self.abort(now_ns, reason)
        return outputs

    def restart_sensor(self, t_ns: int, sensor: str) -> list[Output]:
        """Discard the static pose, and abort a phase or fit that the restart invalidates.

        The restart may have changed the heading of the sensor. A static phase and a functional fit
        are not aborted.
        """
        recording, fit = self._recording, self._fit
        moving = recording is not None and recording.phase != CalibrationPhase.STATIC
        # The result of a functional phase remains valid; the notice requests a new static pose.
        outdated = fit is not None and not isinstance(fit.work, FunctionalJob)
        outputs: list[Output] = []
        if moving or outdated:
            outputs += self.abort(t_ns, f"{sensor} restarted during the phase: repeat it")

        posed, self._static = self._static is not None, None
        if posed or self._alignment is not None or self.calibration is not None:
            text = (
                "restarted, so its heading may have changed (without a magnetometer it always "
                "does). Repeat the align phase, if you used it, and then the static pose"
            )
            outputs.append(Notice(t_ns, NoticeKind.CALIBRATION, sensor, text, NoticeLevel.WARNING))
        return outputs

    # --- requests ----------------------------------------------------------------------------

    def request(self, request: Request) -> list[Output]:
        """Start or abort a phase, or revert online learning; the outputs contain the reply."""
        wanted = str(request.arguments.get("phase", ""))
        if request.command == "static":
            wanted = "static"
        if wanted == "revert":
            return self._revert_refits(request)
        if wanted == "abort":
            outputs = self.abort(request.t_ns, "abort requested")
            return [*outputs, request.reply("ok", {"phase": self.phase})]

        wanted_s = requested_seconds(request.arguments.get("seconds"))
        key, message = "phase", PLANAR if self._chain.planar else self._refusal(wanted)
        if message is None and wanted_s is not None and not 0.0 < wanted_s <= MAX_PHASE_S:
            key, message = "seconds", f"expected a number above 0 and up to {MAX_PHASE_S}"
        if message is not None:
            return [request.refusal(key, message)]

        phase = CalibrationPhase(wanted)
        self._force = request.arguments.get("force") is True
        return [
            request.reply("accepted", {"phase": wanted}),
            *self._start(request.t_ns, phase, wanted_s),
        ]

    def _revert_refits(self, request: Request) -> list[Output]:
        """Restore the models from before online learning; pause it until a functional phase."""
        now, running = self.calibration, self._state not in RESTING
        before = None if now is None or running else self.refits.revert(now)
        if before is None:
            message = "no online learning since the daemon started: there is nothing to revert"
            return [request.refusal("phase", self._running_text if running else message)]

        self.calibration, self.version = before, None
        text = "online learning reverted and paused until the next functional calibration"
        return [
            request.reply("ok", {"phase": self.phase}),
            CalibrationReady(before),
            self.status(request.t_ns, text),
        ]

    def select(self, event: CalibrationSelected) -> list[Output]:
        """Use a stored calibration, and pause online learning until the next functional phase.

        The calibration is stored again as a new version, because the daemon uses the newest version
        after a restart.
        """
        request, chosen = event.request, event.calibration
        if self._state not in RESTING:
            return [request.refusal("version", self._running_text)]
        if not chosen.fits(self._chain):
            message = (
                f"version {event.version} belongs to another limb or other sensors than rig.toml: "
                "choose a version with `usable` from the answer to `calibrations`"
            )
            return [request.refusal("version", message)]

        quality = {**chosen.quality, "restored": {"from_version": event.version}}
        self.calibration = replace(chosen, quality=quality)
        self.version, self.refits = None, OnlineRefits(paused=True)
        text = f"version {event.version} is used again"
        return [
            request.reply("ok", {"version": event.version, "phase": self.phase}),
            CalibrationReady(self.calibration, keep_date=True),
            self.status(event.t_ns, text),
        ]

    @property
    def _running_text(self) -> str:
        return (
            f"phase '{self.phase}' is running: wait until it ends, or abort it with"
            ' `jointfit calibrate RIG.toml --abort` (over MQTT: {"phase":"abort"})'
        )

    def request_refit(self, fresh: OnlineFrames) -> list[Output]:
        """Request a refit of the models to new frames. Call it only while ``may_learn``."""
        if self.calibration is None:
            return []
        self._jobs += 1
        self.refits.job = self._jobs
        return [FitJob(self._jobs, RefitJob(self._chain, self.calibration, fresh))]

    def _refusal(self, wanted: str) -> str | None:
        """Return the reason why a phase cannot start; None if it can."""
        settings = self._settings
        if wanted not in COLLECTING:
            return f"expected one of {', '.join(COLLECTING)}, abort, revert; got {wanted!r}"
        if self._state not in RESTING:
            return self._running_text

        if wanted != "static" and not self._mocap:
            return f"{wanted!r} needs a mocap system: add [mocap] to rig.toml"
        if wanted == "functional":
            return self._functional_refusal()
        if wanted == "static" or settings.plate is not None or PLATE in settings.markers:
            return None
        return (
            "'align' needs the plate that carries the sensors: name its rigid body in rig.toml "
            '([mocap] plate = "Plate") or its markers (markers.plate = [...])'
        )

    def _functional_refusal(self) -> str | None:
        """Return why the functional phase cannot start; None if markers and pose are complete."""
        named = {*self._settings.markers, *self._settings.rigid_bodies}
        bare = [segment for segment in self._chain.segments if segment not in named]
        if bare:
            return (
                f"'functional' needs markers on {', '.join(bare)}: name three or more in rig.toml "
                f"([mocap] markers.{bare[0]} = [...]) or a rigid body (rigid_body.{bare[0]} = "
                '"..."), then repeat the static pose'
            )
        if self._static is None:
            return "'functional' needs a static pose first: request static and stand still"
        if self._static.optical is None:
            return "no mocap data of the static pose: repeat it in view of the cameras"
        return None

    def _start(self, t_ns: int, phase: CalibrationPhase, requested_s: float | None) -> list[Output]:
        self._change(START[phase])
        guide, settings = None, self._settings
        if phase == CalibrationPhase.FUNCTIONAL:
            guide = MovementGuide(self._chain, settings, self._static)

        default_s = {
            CalibrationPhase.ALIGN: settings.align_s,
            CalibrationPhase.STATIC: settings.static_s,
            CalibrationPhase.FUNCTIONAL: settings.functional_s,
        }
        wanted_s = min(requested_s or default_s[phase], MAX_PHASE_S)
        min_s = settings.functional_min_s
        self._recording = PhaseRecording(
            phase, self._chain, t_ns, wanted_s, guide=guide, min_s=min_s
        )
        most = "at most " if guide is not None else ""
        return [self.status(t_ns, f"{INSTRUCTIONS[phase]}, {most}{wanted_s:g} s", phase)]

    def _change(self, event: SessionEvent) -> None:
        self._state = TRANSITIONS[self._state, event]

    # --- fits --------------------------------------------------------------------------------

    def _start_fit(self, recording: PhaseRecording, now_ns: int) -> list[Output]:
        self._change(SessionEvent.RECORDED)
        self._recording = None
        phase = recording.phase
        if phase == CalibrationPhase.STATIC:
            self._static_s = recording.wanted_s

        self._jobs += 1
        self.refits.job = None  # The single worker stops a running refit for this fit.
        self._fit = FitJob(self._jobs, self._job(phase, recording.trial(now_ns)))

        outputs: list[Output] = []
        if recording.overflowed:
            text = (
                f"{recording.overflowed} measurements exceeded the size of the recording and were "
                "dropped: choose a shorter phase"
            )
            outputs += _notices(now_ns, phase, [text])
        outputs += _notices(now_ns, phase, recording.missing)
        text = "; ".join((f"fitting the {phase} trial", *recording.missing))
        return [*outputs, self.status(now_ns, text, CalibrationPhase.FITTING), self._fit]

    def _job(self, phase: CalibrationPhase, trial: CalibrationTrial) -> CalibrationJob:
        """Return the fit that must follow the phase that ended."""
        chain, settings = self._chain, replace(self._settings, static_s=self._static_s)
        lag_ns = None if self.lags is None else self.lags.known_lags_ns()
        if phase == CalibrationPhase.ALIGN:
            return AlignJob(chain, settings, trial, lag_ns)

        alignment, previous = self._alignment, self.calibration
        if phase == CalibrationPhase.STATIC or self._static is None:
            return StaticJob(chain, settings, trial, alignment, previous)
        tracked = None if self.lags is None else self.lags.tracked_lags()
        return FunctionalJob(
            chain, settings, self._static, trial, alignment, previous, lag_ns, tracked
        )

    def report_job(self, event: JobProgress) -> list[Output]:
        """Publish the progress of the running fit. The progress of cancelled jobs is ignored."""
        if self._fit is None or event.job != self._fit.job:
            return []
        fitting = CalibrationPhase.FITTING
        return [CalibrationProgress(event.t_ns, fitting, round(event.progress, 3), event.text)]

    def finish_job(self, event: JobFinished) -> list[Output]:
        """Use the result of a fit from the worker. Results of cancelled jobs are ignored."""
        fit = self._fit
        if event.job == self.refits.job and self.calibration is not None:
            found, notice = self.refits.finish(event, self.calibration, self.version)
            if found is None:
                return [notice]
            self.calibration, self.version = found, None
            text = "models from online learning are in use"
            return [notice, CalibrationReady(found), self.status(event.t_ns, text)]
        if fit is None or event.job != fit.job:
            return []

        self._fit = None
        failure, work = event.failure, fit.work
        if isinstance(work, StaticJob):
            self._static = work.static if failure is None else None
        if event.result is None or failure is not None:
            self._change(SessionEvent.FAILED)
            text = f"{work.name}: {failure}"
            return [self.status(event.t_ns, text, CalibrationPhase.ABORTED)]
        return self._use_result(event.t_ns, CalibrationPhase(work.name), event.result)

    def _use_result(self, t_ns: int, phase: CalibrationPhase, result: FitResult) -> list[Output]:
        quality = result.quality
        if result.alignment is not None:
            self._change(SessionEvent.ALIGNMENT_FITTED)
            self._alignment = result.alignment
            text, quality = alignment_text(quality), {"alignment": quality}
            status = self.status(t_ns, text, CalibrationPhase.ALIGNED, quality)
            return [*_notices(t_ns, phase, result.alignment.get("notes", ())), status]

        static = phase == CalibrationPhase.STATIC
        quality = {"static": quality} if static else quality
        if result.calibration is None:
            self._change(SessionEvent.POSE_FITTED)
            return [self.status(t_ns, "static pose recorded", CalibrationPhase.POSED, quality)]

        if (worse := result.worse) is not None and not self._force:
            self._change(SessionEvent.RESULT_WORSE)
            text = f"new calibration rejected, it is worse than the stored one: {worse}; use force"
            status = self.status(t_ns, f"{text} to replace it")
            return [replace(status, kept=worse, refused=quality)]

        self._change(SessionEvent.POSE_FITTED if static else SessionEvent.CALIBRATION_FITTED)
        self.calibration, self.version = result.calibration, None
        if phase == CalibrationPhase.FUNCTIONAL:
            self.refits = OnlineRefits()
        text = "static pose recorded: sensor alignments updated" if static else "calibrated"
        return [
            *(() if static else _notices(t_ns, phase, self.calibration.notes)),
            *_notices(t_ns, phase, result.notes or (), NoticeLevel.INFO),
            CalibrationReady(self.calibration),
            self.status(t_ns, text, self._state, quality),
        ]

    def set_stored_version(self, event: CalibrationStored) -> list[Output]:
        """Set the version of the current calibration after it was stored."""
        self.version, self._created_utc = event.version, event.created_utc
        return [self.status(event.t_ns, f"stored as version {event.version}")]

    def status(
        self,
        t_ns: int,
        text: str,
        phase: CalibrationPhase | None = None,
        quality: Mapping[str, object] | None = None,
    ) -> CalibrationStatus:
        """Return a status.

        By default, it describes the current phase and the current calibration.
        """
        if quality is None:
            quality = {} if self.calibration is None else self.calibration.quality
        created_utc = None if self.version is None else self._created_utc or None
        return CalibrationStatus(
            t_ns,
            phase or self.phase,
            text,
            self.version,
            quality,
            done=self._done,
            created_utc=created_utc,
        )

    def abort(self, t_ns: int, reason: str) -> list[Output]:
        """Abort the running phase or fit; do nothing if none is running."""
        if self._state in RESTING:
            return []
        outputs: list[Output] = []
        if self._fit is not None:
            outputs.append(CancelJob(self._fit.job))
        self._change(SessionEvent.FAILED)
        self._recording = self._fit = None
        return [*outputs, self.status(t_ns, reason, CalibrationPhase.ABORTED)]


def _notices(
    t_ns: int,
    phase: CalibrationPhase,
    notes: Sequence[str],
    level: NoticeLevel = NoticeLevel.WARNING,
) -> list[Output]:
    return [Notice(t_ns, NoticeKind.CALIBRATION, phase, note, level) for note in notes]
